"""An object store on this machine that talks as S3 does.

Tests that use it are marked `xdist_group("object store")`: one worker imports moto, not two.
"""

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.request import Request, urlopen

import pytest

_READ_ONLY = {
    "Version": "2012-10-17",
    "Statement": [
        {"Effect": "Allow", "Action": ["s3:GetObject", "s3:ListBucket"], "Resource": "*"}
    ],
}


@contextmanager
def object_store(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """moto, with an empty bucket; its address."""
    from moto.server import ThreadedMotoServer

    # It logs every request where the errors of commands go.
    monkeypatch.setattr(logging.getLogger("werkzeug"), "disabled", True)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    try:
        # What another test has left in this process.
        _post(f"{host}:{port}", "reset")
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
            "AWS_ACCESS_KEY_ID": "nobody",
            "AWS_SECRET_ACCESS_KEY": "nothing",
            "AWS_DEFAULT_REGION": "us-east-1",
        }.items():
            monkeypatch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir("bucket")
        yield "s3://bucket"
    finally:
        server.stop()


@contextmanager
def read_only(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have the server of `object_store` check keys, and use those of a user who may only read."""
    import boto3
    from moto import settings

    iam = boto3.client("iam")
    iam.create_user(UserName="reader")
    iam.put_user_policy(UserName="reader", PolicyName="read", PolicyDocument=json.dumps(_READ_ONLY))
    key = iam.create_access_key(UserName="reader")["AccessKey"]
    where = os.environ["AWS_ENDPOINT_URL"].removeprefix("http://")
    before = str(settings.INITIAL_NO_AUTH_ACTION_COUNT)
    _post(where, "reset-auth", b"0")  # so many requests are not checked
    try:
        use_keys(monkeypatch, key["AccessKeyId"], key["SecretAccessKey"])
        yield
    finally:
        _post(where, "reset-auth", before.encode())


def use_keys(monkeypatch: pytest.MonkeyPatch, key_id: str, secret: str) -> None:
    """Have all that is opened from now on use these credentials."""
    import s3fs

    monkeypatch.setenv("AWS_ACCESS_KEY_ID", key_id)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", secret)
    s3fs.S3FileSystem.clear_instance_cache()


def _post(where: str, what: str, content: bytes = b"") -> None:
    address = f"http://{where}/moto-api/{what}"
    # As a form the server would take the content for itself.
    headers = {"Content-Type": "text/plain"}
    urlopen(Request(address, data=content, method="POST", headers=headers)).close()
