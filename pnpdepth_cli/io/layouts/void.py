"""`void`: VOID, <sequence>/ with image/ sparse_depth/ ground_truth/ and K.txt.

The folder may be a sequence, data/, void_150, void_500 or void_1500, or void_release. Depth is in
16-bit PNGs of metres × 256. Where test_image.txt lists the test split, only its frames are taken.
"""

from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Frame, Listing, Unmatched, by_stem, without_partner
from pnpdepth_cli.io.file_bytes import read_bytes
from pnpdepth_cli.io.layouts import Layout

_PNG = (".png",)
_SCALE = 256.0
_PARTS = ("image", "sparse_depth", "ground_truth")


def matches(root: Path) -> bool:
    """Returns whether there is a sequence at most three levels below."""
    return bool(_sequences(root))


def listing(root: Path) -> Listing:
    """Returns one frame for each image with sparse depth."""
    frames: list[Frame] = []
    broken: list[Unmatched] = []
    for sequence in _sequences(root):
        images, sparse, gt = (by_stem(sequence / part, _PNG) for part in _PARTS)
        wanted = _test_split(sequence)
        prefix = sequence.relative_to(root).as_posix()
        calib = sequence / "K.txt"
        frames += [
            Frame(
                name=stem if prefix == "." else f"{prefix}/{stem}",
                image=image,
                sparse=sparse[stem],
                sparse_scale=_SCALE,
                gt=gt.get(stem),
                gt_scale=_SCALE,
                calib=calib if calib.is_file() else None,
            )
            for stem, image in images.items()
            if stem in sparse and (wanted is None or (sequence.name, stem) in wanted)
        ]
        broken += without_partner(images, sparse, sequence / "sparse_depth")
    return Listing(frames=frames, broken=tuple(broken))


def _sequences(root: Path) -> list[Path]:
    starts = ("", "*/", "data/*/", "*/data/*/")
    sequences = {p.parent for start in starts for p in root.glob(f"{start}sparse_depth")}
    return sorted(p for p in sequences if all((p / part).is_dir() for part in _PARTS))


def _test_split(sequence: Path) -> set[tuple[str, str]] | None:
    """(sequence, stem) of the frames of the test split; None without its list."""
    path = sequence.parent.parent / "test_image.txt"
    if sequence.parent.name != "data" or not path.is_file():
        return None
    lines = read_bytes(path).decode("utf-8", "replace").split()
    paths = [Path(line) for line in lines]
    return {(p.parts[-3], p.stem) for p in paths if len(p.parts) >= 3}


LAYOUT = Layout(matches=matches, listing=listing, needs=("image", "sparse_depth", "ground_truth"))
