// Questions to a person, as the page's own dialogs.

import { el } from "./dom";

/** Shows a dialog until it is closed; gives the value of the button that closed it, "" for none. */
export function modal(title: string, className: string, ...content: (Node | null)[]): [HTMLDialogElement, Promise<string>] {
  const heading = el("h2", { textContent: title, id: `dialog-${Date.now()}` });
  const dialog = el("dialog", { className: `box ${className}` }, heading, ...content);
  dialog.setAttribute("aria-labelledby", heading.id);
  const closed = new Promise<string>((resolve) => {
    dialog.onclose = () => {
      dialog.remove();
      resolve(dialog.returnValue);
    };
  });
  dialog.addEventListener("keydown", (e) => e.stopPropagation()); // keys are not for the page below
  document.body.append(dialog);
  dialog.showModal();
  return [dialog, closed];
}

const cancel = (): HTMLElement => el("button", { textContent: "Cancel", value: "", formNoValidate: true });

/** The text that somebody gives; null when they give none. */
export async function askText(title: string, value: string, hint = "", more: { maxLength?: number; inputMode?: string } = {}): Promise<string | null> {
  const input = el("input", { type: "text", value, autofocus: true, ...more });
  input.setAttribute("aria-label", title);
  const act = el("button", { textContent: "Save", value: "yes", className: "on" });
  const form = el("form", { method: "dialog" }, input, hint ? el("p", { className: "quiet", textContent: hint }) : null, el("p", { className: "acts" }, act, cancel()));
  const [, closed] = modal(title, "ask", form);
  input.select();
  return (await closed) === "yes" ? input.value : null;
}

/** Whether somebody wants what a button names. */
export async function sure(question: string, act: string): Promise<boolean> {
  const yes = el("button", { textContent: act, value: "yes", className: "on", autofocus: true });
  const [, closed] = modal(question, "ask", el("form", { method: "dialog" }, el("p", { className: "acts" }, yes, cancel())));
  return (await closed) === "yes";
}
