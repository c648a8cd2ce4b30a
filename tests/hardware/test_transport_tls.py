"""Stations over TLS with certificates on both sides, as docs/stations.md describes; certificates made by openssl."""

import shutil
import subprocess

import pytest
from loopback import until
from needs import needs_module
from test_transport_engines import free_endpoint

from hardware.transport import Trust, open_transport

KEY = Trust(bytes(range(32)))
EC = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
STRANGER_S = 2.0
"""A query of somebody who is let in is answered in milliseconds; the control below shows it."""


def openssl(*arguments):
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)


def authority(folder, name):
    openssl(
        "req", "-x509", *EC, "-days", 2, "-subj", f"/CN={name}",
        "-keyout", folder / f"{name}.key", "-out", folder / f"{name}.pem",
        "-addext", "keyUsage=critical,keyCertSign",
    )  # fmt: skip


def certificate(folder, name, by):
    """A certificate of the PC ``name``, at 127.0.0.1, signed by the authority ``by``."""
    stem = folder / name
    openssl("req", *EC, "-subj", f"/CN={name}", "-keyout", f"{stem}.key", "-out", f"{stem}.csr")
    (folder / "extensions").write_text("subjectAltName=IP:127.0.0.1\n")
    openssl(
        "x509", "-req", "-in", f"{stem}.csr", "-CA", folder / f"{by}.pem", "-CAkey", folder / f"{by}.key",
        "-CAcreateserial", "-days", 2, "-extfile", folder / "extensions", "-out", f"{stem}.pem",
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    needs_module("zenoh", "stations")
    if shutil.which("openssl") is None:
        pytest.skip("the program 'openssl' is not installed (Debian: apt install openssl)")
    made = tmp_path_factory.mktemp("tls")
    for name in ("lab", "other"):
        authority(made, name)
    for name, by in (("pc1", "lab"), ("a", "lab"), ("stranger", "other")):
        certificate(made, name, by)
    return made


def tls(endpoint, folder, end, name, mutual=True, authority="lab"):
    """Return the endpoint in TLS for ``end`` "listen" or "connect", with PC ``name``'s certificate (None: none)."""
    own = {} if name is None else {
        f"{end}_certificate_file": folder / f"{name}.pem", f"{end}_private_key_file": folder / f"{name}.key",
    }  # fmt: skip
    keys = {"root_ca_certificate_file": folder / f"{authority}.pem", **own, "enable_mtls": str(mutual).lower()}
    return endpoint.replace("tcp/", "tls/") + "#" + ";".join(f"{key}={value}" for key, value in keys.items())


def asked(endpoint, refused=False):
    """Return the answer that a program at ``endpoint`` gets, None where ``refused`` expects none."""
    end, answers = open_transport(connect=[endpoint], trust=KEY), []
    try:
        until(
            lambda: answers.append(end.query("mosca/A/clock", b"", 0.2)) or answers[-1]
            or (refused and len(answers) * 0.2 >= STRANGER_S)
        )  # fmt: skip
        return answers[-1]
    finally:
        end.close()


@pytest.mark.parametrize("mutual", [True, False])
def test_certificates_on_both_sides_let_in_whom_the_authority_signed(folder, mutual):
    """Without ``enable_mtls`` only the listening side proves who it is: the control."""
    endpoint = free_endpoint()
    here = open_transport(listen=[tls(endpoint, folder, "listen", "pc1", mutual)], trust=KEY)
    here.declare_queryable("mosca/A/clock", lambda question: b"answer")
    try:
        assert asked(tls(endpoint, folder, "connect", "a")) == b"answer"
        nameless = asked(tls(endpoint, folder, "connect", None, False), refused=mutual)
        assert nameless == (None if mutual else b"answer")
        if mutual:
            assert asked(tls(endpoint, folder, "connect", "stranger"), refused=True) is None
        # the listening PC's certificate is not of the authority that this one trusts; no TLS
        assert asked(tls(endpoint, folder, "connect", "a", mutual, "other"), refused=True) is None
        assert asked(endpoint, refused=True) is None
    finally:
        here.close()
