"""A fleet: its members, their rights, and their keys.

There is one authority, and one certificate per drone, ground station and viewer with the common
name ``<role>.<name>``. Only ground stations have server certificates, so a drone's stolen key
cannot impersonate a ground station. ``fleet.json`` in a ground station's folder lists the members;
removing a drone or viewer from it revokes its rights. A drone trusts every ground station of its
authority, so revoking a ground station needs a new authority.
"""

from __future__ import annotations

import datetime
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import InputError
from service.packages import needing
from service.stream.naming import ROOT, check_name

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

    Authority = tuple[x509.Certificate, EllipticCurvePrivateKey]

FLEET = "fleet.json"
ROLES = ("drone", "ground", "viewer")


@dataclass(frozen=True, slots=True)
class Fleet:
    """The members of a fleet by role, and the number of revoked certificates per subject."""

    members: dict[str, tuple[str, ...]] = field(default_factory=dict)
    revoked: dict[str, int] = field(default_factory=dict)  # by "<role>.<name>"

    @property
    def everybody(self) -> list[tuple[str, str]]:
        return [(role, name) for role, names in self.members.items() for name in names]

    def with_members(self, role: str, names: Sequence[str]) -> Fleet:
        merged = tuple(sorted({*self.members.get(role, ()), *names}))
        return Fleet({**self.members, role: merged}, self.revoked)

    def without(self, role: str, name: str) -> Fleet:
        """The fleet without a member, whose certificates lose all rights permanently."""
        subject = f"{role}.{name}"
        rest = tuple(other for other in self.members[role] if other != name)
        revoked = {**self.revoked, subject: self.revoked.get(subject, 0) + 1}
        return Fleet({**self.members, role: rest}, revoked)

    def common_name(self, role: str, name: str) -> str:
        """The common name of a member's only valid certificate.

        ``<role>.<name>``, and after a revocation ``<role>.<name>~2``, ``~3`` and so on: no name
        contains a tilde, so an old certificate never matches again.
        """
        subject = f"{role}.{name}"
        count = self.revoked.get(subject, 0)
        return f"{subject}~{count + 1}" if count else subject


def load_fleet(path: Path) -> Fleet:
    """The fleet in a ``fleet.json``; raises InputError when it is missing or invalid."""
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
        members = {role: tuple(map(str, raw[role])) for role in ROLES if role in raw}
        revoked = {str(key): int(count) for key, count in raw.get("revoked", {}).items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path} is not a fleet.json; make it with 'skyrelief keys'") from error
    fleet = Fleet(members, revoked)
    for _, name in fleet.everybody:
        check_name(name, "fleet member")
    return fleet


def _rights(role: str, name: str) -> list[tuple[str, Sequence[str], str]]:
    """Flow, messages and keys of each right of a member."""
    everything = ("put", "query", "reply", "declare_subscriber", "declare_queryable")
    own, everywhere = f"{ROOT}/{name}/**", f"{ROOT}/**"
    if role == "drone":
        return [("ingress", everything, own), ("egress", everything, own)]
    if role == "viewer":
        return [("ingress", ("declare_subscriber",), everywhere), ("egress", ("put",), everywhere)]
    return [
        ("ingress", ("put",), f"{ROOT}/*/*/held/{name}"),
        ("ingress", ("declare_subscriber", "query"), everywhere),
        ("egress", everything, everywhere),
    ]


def access_control(fleet: Fleet) -> dict[str, Any]:
    """Zenoh's access control for a ground station's router.

    A drone may only use keys below its own. A viewer may only read. A ground station may read,
    query, and report under its own name. Others may do nothing: Zenoh checks no revocation lists,
    so a revoked certificate still connects but has no rights.
    """
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for role, name in fleet.everybody:
        subject = f"{role}.{name}"
        subjects.append({"id": subject, "cert_common_names": [fleet.common_name(role, name)]})
        ids = []
        for k, (flow, messages, key) in enumerate(_rights(role, name)):
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
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


CA, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"
CA_DAYS = 3650
EVER = datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
"""Certificates are valid from this date, because an aircraft's clock may be unset."""


def tls_files(folder: Path) -> tuple[str, str, str]:
    """Authority, certificate and key in a member's folder; raises InputError when missing."""
    paths = [folder / name for name in (CA, CERTIFICATE, KEY)]
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path} does not exist; make it with 'skyrelief keys'")
    return str(paths[0]), str(paths[1]), str(paths[2])


def expiry_unix_s(certificate: Path) -> float:
    """Expiry of a certificate (PEM), unix s; InputError for any other file. Raises OutsideError
    without the ``cryptography`` package."""
    return _read(certificate).not_valid_after_utc.timestamp()


def member_name(certificate: Path) -> str:
    """Name of the member in a certificate (PEM); InputError for any other file. Raises OutsideError
    without the ``cryptography`` package."""
    read = _read(certificate)
    from cryptography.x509.oid import NameOID

    found = read.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    _, _, name = str(found[0].value).partition(".") if found else ("", "", "")
    return check_name(name.partition("~")[0], "the member of the certificate")


def _read(certificate: Path) -> x509.Certificate:
    with needing("reading certificates"):
        from cryptography import x509
    try:
        return x509.load_pem_x509_certificate(certificate.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{certificate} is not a certificate ({error})") from error


def make_keys(
    folder: Path, members: Mapping[str, Sequence[str]], days: int = 365, now: float | None = None
) -> list[Path]:
    """Make certificates for new ``members`` (role to names); returns their folders.

    The authority is created once and reused. Members with keys keep them. Raises InputError for
    invalid names, OutsideError without the ``cryptography`` package.
    """
    for names in members.values():
        for name in names:
            check_name(name, "fleet member")
    utc = datetime.timezone.utc
    start = datetime.datetime.now(utc) if now is None else datetime.datetime.fromtimestamp(now, utc)
    try:
        authority = _authority(folder / "authority", start)
        path = folder / FLEET
        fleet = load_fleet(path) if path.exists() else Fleet()
        made = []
        for role, names in members.items():
            fleet = fleet.with_members(role, names)
            for name in names:
                home, common_name = folder / role / name, fleet.common_name(role, name)
                if not (home / KEY).exists():
                    _member(home, common_name, role == "ground", authority, start, days)
                    made.append(home)
        _write_fleet(folder, fleet)
    except OSError as error:
        raise InputError(f"cannot write keys in {folder}: {error.strerror}") from error
    return made


def revoke(folder: Path, member: str, days: int = 365) -> list[Path]:
    """Revoke the certificate of ``member`` (a name, or ``<role>.<name>``); returns files to copy.

    A drone or viewer loses its rights through the ``fleet.json`` of every ground station. For a
    ground station the authority is replaced, and all other members get new keys. Revoked files are
    moved to ``folder/revoked``. Raises InputError for an unknown name.
    """
    fleet = load_fleet(folder / FLEET)
    role, name = _named(fleet, member)
    try:
        rest = fleet.without(role, name)
        if role != "ground":
            stations = _write_fleet(folder, rest)
            _put_away(folder, folder / role / name)
            return stations
        for other in fleet.everybody:
            _put_away(folder, folder.joinpath(*other))
        _put_away(folder, folder / "authority")
        _write_fleet(folder, rest)
    except OSError as error:
        raise InputError(f"cannot write keys in {folder}: {error.strerror}") from error
    return make_keys(folder, rest.members, days)


def _named(fleet: Fleet, member: str) -> tuple[str, str]:
    """Role and name of the one member called ``member``."""
    found = [both for both in fleet.everybody if member in (both[1], ".".join(both))]
    if not found:
        raise InputError(f"this fleet has no member {member!r}")
    if len(found) > 1:
        names = " or ".join(".".join(both) for both in found)
        raise InputError(f"{member!r} is ambiguous: give {names}")
    return found[0]


def _put_away(folder: Path, home: Path) -> None:
    """Move the keys of a member or the authority to ``folder/revoked``."""
    if not home.is_dir():
        return
    kept = folder / "revoked"
    kept.mkdir(mode=0o700, exist_ok=True)
    stem = home.name if home.parent == folder else f"{home.parent.name}.{home.name}"
    number = sum(1 for path in kept.iterdir() if path.name.startswith(f"{stem}~")) + 1
    home.rename(kept / f"{stem}~{number}")


def _write_fleet(folder: Path, fleet: Fleet) -> list[Path]:
    """Write ``fleet.json`` for the folder and every ground station; returns the latter."""
    text = json.dumps({**fleet.members, "revoked": fleet.revoked}, indent=2) + "\n"
    stations = [folder / "ground" / name for name in fleet.members.get("ground", ())]
    copies = [home / FLEET for home in stations if home.is_dir()]
    for path in (folder / FLEET, *copies):
        part = path.with_suffix(".part")
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    return copies


def _authority(folder: Path, start: datetime.datetime) -> Authority:
    with needing("an authority"):
        from cryptography import x509
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ec
    if (folder / KEY).exists():
        key = serialization.load_pem_private_key((folder / KEY).read_bytes(), None)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise InputError(f"{folder / KEY} is not a key of 'skyrelief keys'")
        return x509.load_pem_x509_certificate((folder / CA).read_bytes()), key
    name = "skyrelief fleet authority"
    limits = [x509.BasicConstraints(ca=True, path_length=0)]
    return _signed(folder, CA, name, start + datetime.timedelta(days=CA_DAYS), limits)


def _member(
    home: Path,
    common_name: str,
    server: bool,
    authority: Authority,
    start: datetime.datetime,
    days: int,
) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.x509.oid import ExtendedKeyUsageOID

    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if server:
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
    extensions = [
        x509.BasicConstraints(ca=False, path_length=None),
        x509.SubjectAlternativeName([x509.DNSName(common_name)]),
        x509.ExtendedKeyUsage(usages),
    ]
    end = start + datetime.timedelta(days=days)
    _signed(home, CERTIFICATE, common_name, end, extensions, authority)
    (home / CA).write_bytes(authority[0].public_bytes(serialization.Encoding.PEM))


def _signed(
    home: Path,
    file: str,
    common_name: str,
    end: datetime.datetime,
    extensions: Sequence[x509.ExtensionType],
    authority: Authority | None = None,
) -> Authority:
    """A new certificate and its key, written into ``home``; the first extension is critical.
    Without an ``authority`` it is one, signed by its own key."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, common_name)])
    builder = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(authority[0].subject if authority else name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(EVER)
        .not_valid_after(end)
    )
    for extension in extensions:
        builder = builder.add_extension(extension, critical=extension is extensions[0])
    certificate = builder.sign(authority[1] if authority else key, hashes.SHA256())
    home.mkdir(parents=True, exist_ok=True)
    how = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    with open(os.open(home / KEY, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as secret:
        secret.write(key.private_bytes(serialization.Encoding.PEM, *how))
    (home / file).write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    return certificate, key
