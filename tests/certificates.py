"""Throw-away certificates, made by openssl."""

import hashlib
import shutil
import ssl
import subprocess

import pytest

needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")

AUTHORITY = """
[ca]
default_ca = authority
[authority]
database = {folder}/{name}.index
serial = {folder}/{name}.serial
new_certs_dir = {folder}
default_md = sha256
policy = policy
[policy]
commonName = supplied
"""
VALID, EXPIRED = ("20200101000000Z", "20990101000000Z"), ("20200101000000Z", "20200201000000Z")


def certify(folder, name, host, dates):
    """A self-signed certificate, as an operator would make one; returns its file and its key's."""
    key, request, certificate = (folder / f"{name}.{kind}" for kind in ("key", "request", "pem"))
    (folder / f"{name}.index").touch()
    (folder / f"{name}.serial").write_text("01\n")
    (folder / f"{name}.conf").write_text(AUTHORITY.format(folder=folder, name=name))
    (folder / f"{name}.extensions").write_text(f"subjectAltName=IP:{host}\n")
    make = ["req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", "/CN=server"]
    sign = ["ca", "-batch", "-selfsign", "-notext", "-config", folder / f"{name}.conf", "-keyfile", key]
    sign += ["-startdate", dates[0], "-enddate", dates[1], "-extfile", folder / f"{name}.extensions"]
    for command in ([*make, "-keyout", key, "-out", request], [*sign, "-in", request, "-out", certificate]):
        subprocess.run(["openssl", *map(str, command)], check=True, capture_output=True)
    return certificate, key


def fingerprint(certificate):
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(certificate.read_text())).hexdigest()
