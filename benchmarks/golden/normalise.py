"""Reduces what a command printed and wrote to what is the same in every run."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.golden.inputs import ROOT
from benchmarks.golden.steps import Step

Array = NDArray[Any]

_PROGRESS = re.compile(r"^\w+:\s+\d+%\||^\d+ of \d+ \w+, .* left")
_TIME = re.compile(r"(?<![\w.,–-])\d[\d,]*(?:\.\d+)?(?:–\d[\d,.]*)? (?:ms|s|MB|frames/s)\b")
_MEASURED_TEXT = (
    (re.compile(r"\d+(?:\.\d+)? × as fast"), "# × as fast"),
    (re.compile(r"\d+(?:\.\d+)? a second\b"), "# a second"),
    (re.compile(r"(pnpdepth,? (?:version )?)\d+\.\d+\.\d+\w*"), r"\1#"),
)
NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")
_MEASURED = re.compile(
    r"^(versions?|seconds(_\w+)?|\w+_(ms|mb|seconds)|[cm]time_ns|crc32|run|time_s|frames_per_second|network_busy)$"
)
_IMAGES = (".png", ".jpg", ".jpeg", ".tiff", ".tif")
_MOST_LINES = 120
"""Of a file; of longer ones some lines and the hash of all are kept."""


class Normaliser:
    """Removes from the output of a command what differs between runs."""

    def __init__(self, work: Path, shared: Path | None) -> None:
        folders = [(work / "in", "<in>"), (work / "shared", "<shared>")]
        if shared is not None:
            folders.append((shared, "<shared>"))
        self._folders = [(str(path), name) for path, name in folders]
        self._work = re.compile(re.escape(str(work)) + r"/[\w.-]+")
        self._tree = re.compile(re.escape(str(ROOT)) + r"/(?:[\w.-]+/)*")

    def text(self, text: str) -> str:
        """Without absolute paths, times, memory and versions."""
        for path, name in self._folders:
            text = text.replace(path, name)
        text = self._tree.sub("<tree>/", self._work.sub("<work>", text))
        text = _TIME.sub(lambda match: f"# {match[0].rsplit(' ', 1)[1]}", text)
        for pattern, by in _MEASURED_TEXT:
            text = pattern.sub(by, text)
        return text

    def printed(self, text: str, step: Step) -> Any:
        """What was printed: parsed where it is JSON, else its lines."""
        parsed = _parsed(text)
        if parsed is not None:
            return self.data(parsed, step)
        lines: list[str] = []
        for line in text.split("\n"):
            parts = [part for part in line.split("\r") if not _PROGRESS.match(part)]
            if line and not parts:  # from time to time, on a slow machine
                continue
            if "\r" in line:  # a bar, and the blanks that wiped it out
                parts = [part for part in parts if part.strip()]
                if not parts:
                    continue
            lines.append(self.text("".join(parts).rstrip()))
        while lines and not lines[-1]:
            lines.pop()
        if any(re.search(r" {2}.*# (ms|s)\b|│.*# (ms|s)\b|seconds ┃", line) for line in lines):
            lines = [re.sub(r"([ ─━┄])\1+", r"\1", line).strip() for line in lines]
        times = next((n for n, line in enumerate(lines) if "where the time went" in line), None)
        if times is not None:
            lines[times:] = [
                re.sub(r"([ ─━])\1+", r"\1", NUMBER.sub("#", line)) for line in lines[times:]
            ]
        if not step.figures:
            lines = [re.sub(r"([ ─━])\1+", r"\1", NUMBER.sub("#", line)).strip() for line in lines]
        return sorted(lines) if step.unordered else lines

    def data(self, value: Any, step: Step, key: str = "") -> Any:
        """Parsed JSON without measurements."""
        if _MEASURED.match(key) or (not step.figures and isinstance(value, float)):
            return _blank(value)
        if isinstance(value, dict):
            cleaned = {str(name): self.data(each, step, str(name)) for name, each in value.items()}
            if key.endswith(".json"):  # a record, in which times are
                cleaned |= {name: "#" for name in ("size", "sha256") if name in cleaned}
            if str(cleaned.get("checkpoint", "")).endswith(".pt2"):
                cleaned["checkpoint_sha256"] = "#"  # torch.export writes other bytes every time
            return cleaned
        if isinstance(value, list):
            return [self.data(each, step) for each in value]
        return self.text(value) if isinstance(value, str) else value

    def file(self, path: Path, step: Step) -> dict[str, Any]:
        """What is kept of a file that was written."""
        content, suffix = path.read_bytes(), path.suffix.lower()
        if suffix == ".json":
            return {"json": self.data(json.loads(content), step)}
        if suffix == ".jsonl":
            rows = [self.data(json.loads(line), step) for line in content.decode().splitlines()]
            return {"json": sorted(rows, key=lambda row: json.dumps(row, sort_keys=True))}
        if suffix == ".csv":
            return _some_lines(self._csv(content.decode()))
        if suffix in (".md", ".tex", ".txt"):
            return _some_lines(self.text(content.decode()).splitlines())
        if suffix == ".html":
            return self._page(content.decode(), step)
        kept: dict[str, Any] = {"bytes": _hash(content)}
        try:
            arrays = _arrays(path)
        except Exception as error:
            return kept | {"unreadable": type(error).__name__}
        return kept | {name: _described(values) for name, values in arrays.items()}

    def _csv(self, text: str) -> list[str]:
        rows = list(csv.reader(io.StringIO(text)))
        measured = [_MEASURED.match(name) is not None for name in rows[0]] if rows else []
        return [
            self.text(
                ",".join(
                    "#" if number and known and known[0] else cell
                    for cell, *known in _with(row, measured)
                )
            )
            for number, row in enumerate(rows)
        ]

    def _page(self, text: str, step: Step) -> dict[str, Any]:
        """A page: its parts that hold data as data, the rest as lines, or their hash."""
        kept: dict[str, Any] = {}

        def taken(match: re.Match[str]) -> str:
            parsed = _parsed(match[2])
            if parsed is None:
                kept[f"part {len(kept)}"] = _hash(match[2].encode())
            else:
                kept[f"data {len(kept)}"] = self.data(parsed, step)
            return f"{match[1]}…</"

        body = re.sub(r"(?s)(<(?:script|style)[^>]*>)(.*?)</", taken, text)
        lines = self.text(body).splitlines()
        short = [line if len(line) < 2000 else _hash(line.encode()) for line in lines]
        return kept | {"lines": short}


def _some_lines(lines: list[str]) -> dict[str, Any]:
    if len(lines) <= _MOST_LINES:
        return {"lines": lines}
    some = lines[:: len(lines) // 10]
    return {"count": len(lines), "hash": _hash("\n".join(lines).encode()), "lines": some}


def _with(row: Sequence[str], measured: Sequence[bool]) -> Iterator[tuple[Any, ...]]:
    for index, cell in enumerate(row):
        yield (cell, measured[index]) if index < len(measured) else (cell,)


def _parsed(text: str) -> Any:
    """The JSON in it, an object or a list; None if it is something else."""
    if not text.lstrip().startswith(("{", "[")):
        return None
    try:
        return json.loads(text)
    except ValueError:
        return None


def _blank(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _blank(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_blank(each) for each in value]
    return value if value is None or isinstance(value, bool) else "#"


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


def _arrays(path: Path) -> dict[str, Array]:
    """Arrays in a file of an image, depth or weights; empty for other files."""
    suffix = path.suffix.lower()
    if suffix in _IMAGES:
        with Image.open(path) as image:
            return {"picture": np.asarray(image)}
    if suffix == ".npy":
        return {"array": np.load(path)}
    if suffix == ".npz":
        with np.load(path) as file:
            return {f"array {name}": file[name] for name in file.files}
    if suffix == ".pfm":
        return {"array": _read_pfm(path)}
    if suffix == ".exr":
        import OpenEXR

        with OpenEXR.File(str(path)) as file:
            return {f"channel {n}": c.pixels for n, c in sorted(file.channels().items())}
    if suffix == ".safetensors":
        from safetensors.numpy import load_file

        return {f"tensor {name}": values for name, values in sorted(load_file(path).items())}
    return {}


def _read_pfm(path: Path) -> Array:
    kind, size, scale, values = path.read_bytes().split(b"\n", 3)
    width, height = (int(side) for side in size.split())
    order = "<f4" if float(scale) < 0 else ">f4"
    channels = 3 if kind.strip() == b"PF" else 1
    return np.frombuffer(values, order)[: width * height * channels].reshape(height, -1)[::-1]


def _described(values: Array) -> dict[str, Any]:
    """Its hash, and figures that show how large a difference is."""
    flat = np.ascontiguousarray(values).ravel()
    described: dict[str, Any] = {
        "shape": list(values.shape),
        "dtype": values.dtype.name,
        "hash": _hash(flat.tobytes()),
    }
    known = flat[np.isfinite(flat)] if flat.dtype.kind in "fiu" else flat[:0]
    if known.size:
        numbers = (known.min(), known.max(), known.astype(np.float64).mean())
        described["low, high, mean"] = [float(f"{float(number):.6g}") for number in numbers]
        some = flat[np.linspace(0, flat.size - 1, 8).astype(int)]
        described["some"] = [f"{float(number):.6g}" for number in some]
    return described
