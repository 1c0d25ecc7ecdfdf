"""Who belongs to a fleet, and what each may do: the rights that a ground's router enforces."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from service.errors import InputError
from service.stream.naming import ROOT, check_name

FLEET = "fleet.json"
ROLES = ("drone", "ground", "viewer")


@dataclass(frozen=True, slots=True)
class Fleet:
    """The members of a fleet by role, and how many certificates of each subject are revoked."""

    members: dict[str, tuple[str, ...]] = field(default_factory=dict)
    revoked: dict[str, int] = field(default_factory=dict)  # by "<role>.<name>"

    def with_members(self, role: str, names: Sequence[str]) -> Fleet:
        """The fleet with more members of a role."""
        merged = tuple(sorted({*self.members.get(role, ()), *names}))
        return Fleet({**self.members, role: merged}, self.revoked)

    def without(self, role: str, name: str) -> Fleet:
        """The fleet without a member, whose certificate never has rights again."""
        subject = f"{role}.{name}"
        rest = tuple(other for other in self.members[role] if other != name)
        revoked = {**self.revoked, subject: self.revoked.get(subject, 0) + 1}
        return Fleet({**self.members, role: rest}, revoked)

    def common_name(self, role: str, name: str) -> str:
        """The common name of the only valid certificate of a member.

        ``<role>.<name>``, and after a revocation ``<role>.<name>~2``, ``~3`` and so on: no name
        holds a tilde, so an old certificate never matches again.
        """
        subject = f"{role}.{name}"
        count = self.revoked.get(subject, 0)
        return f"{subject}~{count + 1}" if count else subject


def load_fleet(path: Path) -> Fleet:
    """The fleet that a ``fleet.json`` names; raises InputError when there is none."""
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
        members = {role: tuple(map(str, raw[role])) for role in ROLES if role in raw}
        revoked = {str(key): int(count) for key, count in raw.get("revoked", {}).items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path} names no fleet; make it with 'skyrelief keys'") from error
    for names in members.values():
        for name in names:
            check_name(name, "fleet member")
    return Fleet(members, revoked)


def access_control(fleet: Fleet) -> dict[str, Any]:
    """Zenoh's access control for a ground station's router.

    A drone reaches only what lies under its own key. A viewer only reads. A ground station
    reads, asks, and reports under its own name. Whoever is not of the fleet, or no longer, may
    do nothing: Zenoh checks no revocation lists, so a revoked certificate still connects but has
    no rights.
    """
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def grant(role: str, name: str, *rights: tuple[str, Sequence[str], str]) -> None:
        subject = f"{role}.{name}"
        names = [fleet.common_name(role, name)]
        subjects.append({"id": subject, "cert_common_names": names})
        ids = []
        for k, (flow, messages, key) in enumerate(rights):
            ids.append(f"{subject}.{k}")
            rules.append(
                {
                    "id": ids[-1],
                    "permission": "allow",
                    "flows": [flow],
                    "messages": list(messages),
                    "key_exprs": [key],
                }
            )
        policies.append({"rules": ids, "subjects": [subject]})

    everything = ("put", "query", "reply", "declare_subscriber", "declare_queryable")
    for name in fleet.members.get("drone", ()):
        own = f"{ROOT}/{name}/**"
        grant("drone", name, ("ingress", everything, own), ("egress", everything, own))
    for name in fleet.members.get("viewer", ()):
        grant(
            "viewer",
            name,
            ("ingress", ("declare_subscriber",), f"{ROOT}/**"),
            ("egress", ("put",), f"{ROOT}/**"),
        )
    for name in fleet.members.get("ground", ()):
        grant(
            "ground",
            name,
            ("ingress", ("put",), f"{ROOT}/*/*/held/{name}"),
            ("ingress", ("declare_subscriber", "query"), f"{ROOT}/**"),
            ("egress", everything, f"{ROOT}/**"),
        )
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
