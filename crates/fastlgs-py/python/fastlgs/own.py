"""Masks and embeddings of the caller's own models.

Arrays are written beside the photos, in the layouts that `preprocess` imports (docs/reference/formats.md).
"""

import io
import json
import os
import pathlib

import numpy as np

from ._fastlgs import Error


# Marks files of this module, which may be replaced.
OWN = {"made_by": "fastlgs.write_masks"}


def _is_own(path):
    try:
        return json.loads(path.read_bytes()).get("info") == OWN
    except (ValueError, AttributeError):
        return False


def _images(photos):
    """Returns the folder of the photo files, as `preprocess` finds it."""
    named = [pathlib.Path(photos) / name for name in ("images", "input")]
    return next((folder for folder in named if folder.is_dir()), pathlib.Path(photos))


# File name extensions of photos.
PHOTOS = {".bmp", ".jfif", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}


def write_masks(photos, name, masks, embeddings=None):
    """Writes the masks of a photo, and an embedding for each, for import by `preprocess`.

    Masks are bool (n, height, width) and may overlap. Embeddings are float (n, numbers).
    """
    masks = np.asarray(masks)
    if masks.ndim != 3 or masks.dtype not in (np.bool_, np.uint8):
        raise Error(f"{name}: masks must be bool of shape (n, height, width), not {masks.dtype} of {masks.shape}")
    photos = pathlib.Path(photos)
    if not (_images(photos) / name).is_file():
        raise Error(f"{_images(photos) / name}: there is no such photo")
    place = photos / "masks" / f"{name}.json"
    if place.exists() and not _is_own(place):
        raise Error(f"{place}: this file was not written by write_masks; move it to another folder")
    if embeddings is not None:
        embeddings = np.asarray(embeddings, dtype=np.float32)
        if embeddings.ndim != 2 or len(embeddings) != len(masks) or not np.isfinite(embeddings).all():
            raise Error(f"{name}: {len(masks)} masks need as many rows of finite numbers as embeddings, not {embeddings.shape}")
    height, width = masks.shape[1:]
    listed = [{"segmentation": {"size": [height, width], "counts": run_lengths(mask)}} for mask in masks]
    _write(place, json.dumps({"info": OWN, "annotations": listed}).encode())
    if embeddings is not None:
        data = io.BytesIO()
        np.save(data, embeddings)
        _write(photos / "embeddings" / f"{name}.npy", data.getvalue())


def run_lengths(mask):
    """Returns the run lengths of a mask as in COCO: by columns, starting with background."""
    flat = np.asarray(mask, dtype=bool).T.ravel()
    borders = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts = np.diff(np.concatenate([[0], borders, [flat.size]])).tolist()
    return [0] + counts if flat.size and flat[0] else counts


def _write(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    partial.write_bytes(data)
    partial.replace(path)


def _entry(entry):
    """Returns name, masks and embeddings (or None) of an item of the iterable."""
    parts = tuple(entry) if isinstance(entry, (tuple, list)) else ()
    if len(parts) not in (2, 3) or not isinstance(parts[0], str):
        raise Error("masks are given as (name of a photo, masks) or (name, masks, embeddings), or as a dict of name to masks or (masks, embeddings)")
    return parts[0], parts[1], parts[2] if len(parts) == 3 else None


def _entries(masks):
    """Returns all entries of an iterable or a dict."""
    if not isinstance(masks, dict):
        try:
            return iter(masks)
        except TypeError:
            raise Error(f"masks are given as an iterable or a dict, not {type(masks).__name__}") from None
    return ((name, *own) if isinstance(own, tuple) else (name, own) for name, own in masks.items())


def imported(photos, masks):
    """Writes masks from an iterable of (name, masks) or (name, masks, embeddings), or from a dict.

    Returns the options with which `preprocess` imports them. All photos need masks: for others,
    files of an earlier call would be imported.
    """
    embedded, given = set(), set()
    for entry in _entries(masks):
        name, own, embeddings = _entry(entry)
        write_masks(photos, name, own, embeddings)
        given.add(name)
        embedded.add(embeddings is not None)
    if not embedded:
        raise Error(f"{photos}: no masks were given")
    missing = sorted(path.name for path in _images(photos).iterdir() if path.suffix.lower() in PHOTOS and path.name not in given)
    missing = [name for name in missing if not name.startswith(".")]
    if missing:
        raise Error(f"{photos}: {len(missing)} photos have no masks: {', '.join(missing[:5])}; give masks of all photos, and an empty array for photos without masks")
    if len(embedded) > 1:
        raise Error(f"{photos}: some photos have embeddings and some have none; give them for all or for none")
    return {"segmenter": "import", "encoder": "import"} if embedded.pop() else {"segmenter": "import"}
