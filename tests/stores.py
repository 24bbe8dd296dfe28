"""A local S3 server, for tests."""

from __future__ import annotations

import logging
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SETTINGS = {
    "AWS_ACCESS_KEY_ID": "key",
    "AWS_SECRET_ACCESS_KEY": "very-secret",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true",
}


@contextmanager
def s3_server() -> Iterator[str]:
    """Yields the address of an S3 server on loopback; the environment names it until the end."""
    from moto.server import ThreadedMotoServer

    from pnpdepth_cli.io import remote

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    settings = {**SETTINGS, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    remote._file_system.cache_clear()
    try:
        yield settings["AWS_ENDPOINT_URL"]
    finally:
        remote._file_system.cache_clear()
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value
        server.stop()


class Bucket:
    """A new bucket of the server.

    Args:
        endpoint: The server's address.
    """

    def __init__(self, endpoint: str) -> None:
        import boto3

        self.client: Any = boto3.client("s3", endpoint_url=endpoint)
        self.name = f"b{uuid.uuid4().hex[:12]}"
        self.address = f"s3://{self.name}"
        self.client.create_bucket(Bucket=self.name)

    def put(self, key: str, data: bytes) -> None:
        """Puts an object."""
        self.client.put_object(Bucket=self.name, Key=key, Body=data)

    def put_folder(self, folder: Path, prefix: str) -> None:
        """Puts all files of a folder."""
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.put(f"{prefix}/{path.relative_to(folder).as_posix()}", path.read_bytes())

    def listed(self) -> list[str]:
        """Returns the keys of all objects."""
        objects = self.client.list_objects_v2(Bucket=self.name).get("Contents", [])
        return [each["Key"] for each in objects]

    def get(self, key: str) -> bytes:
        """Returns the content of an object."""
        data: bytes = self.client.get_object(Bucket=self.name, Key=key)["Body"].read()
        return data

    def fetch(self, prefix: str, folder: Path) -> None:
        """Writes the objects below a prefix into a folder."""
        for key in self.listed():
            if key.startswith(f"{prefix}/"):
                target = folder / key.removeprefix(f"{prefix}/")
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(self.get(key))
