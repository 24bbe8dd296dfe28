"""`colmap`: a COLMAP project, images/ and sparse/0/, or sparse/, or a model beside images/.

The images of dense/, which COLMAP undistorts, are a project of their own: dense/images/ and
dense/sparse/. Of several models, sparse/0 to sparse/N, the one with the most images is used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pnpdepth_cli.io.colmap.reading import model_files, read_model
from pnpdepth_cli.io.dataset.find_files import find_files
from pnpdepth_cli.io.dataset.frame import IMAGE_SUFFIXES, Frame, Listing, Unmatched
from pnpdepth_cli.io.layouts.layout import Layout


def _listing(root: Path) -> Listing:
    """One frame for each registered image that exists."""
    models = [read_model(folder) for folder in _models(root)]
    model, photos = max(models, key=lambda each: len(each.images)), root / "images"
    files, unreadable = find_files(photos, IMAGE_SUFFIXES)
    spare = [
        Unmatched(path=path, why=f"is not registered in {model.folder}")
        for path in files.values()
        if path.relative_to(photos).as_posix() not in model.images
    ]
    for other in models:
        if other is not model:
            why = f"is another model, of {len(other.images):,} images, in a unit of its own"
            spare.append(Unmatched(path=other.folder, why=why))
    frames, broken = [], list(unreadable)
    for name, image in sorted(model.images.items()):
        path, turn = photos / name, image.rotation.T  # the pose is the inverse of COLMAP's
        if path.is_file():
            pose = np.column_stack([turn, -turn @ image.translation]).tolist()
            stem = Path(name).with_suffix("").as_posix()
            frames.append(
                Frame(name=stem, image=path, sparse=model.folder, pose=tuple(map(tuple, pose)))
            )
        else:
            why = f"is missing, but registered in {model.folder}; add it"
            broken.append(Unmatched(path=path, why=why))
    return Listing(frames=frames, broken=tuple(broken), spare=tuple(spare))


def _models(root: Path) -> list[Path]:
    """The folders of models, sparse/0 first."""
    sparse = root / "sparse"
    inside = [p for p in sparse.iterdir() if p.name.isdigit()] if sparse.is_dir() else []
    numbered = sorted(inside, key=lambda p: int(p.name))
    return [folder for folder in (*numbered, sparse, root) if model_files(folder)]


COLMAP = Layout(
    matches=lambda root: (root / "images").is_dir() and bool(_models(root)),
    listing=_listing,
    needs=("images", "sparse/*/cameras.*"),
)
