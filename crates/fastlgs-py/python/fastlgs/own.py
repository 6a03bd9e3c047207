"""Masks and embeddings of the caller's own models: arrays, written beside the photos in the layouts that `preprocess` imports (docs/formats.md)."""

import io
import json
import os
import pathlib

import numpy as np

from ._fastlgs import Error


def write_masks(photos, name, masks, embeddings=None):
    """Keeps the masks of a photo, bool (n, height, width), which may overlap, and an embedding for each, float (n, numbers)."""
    masks = np.asarray(masks)
    if masks.ndim != 3 or masks.dtype not in (np.bool_, np.uint8):
        raise Error(f"{name}: masks are bool of (n, height, width), not {masks.dtype} of {masks.shape}")
    photos = pathlib.Path(photos)
    if not (photos / "images" / name).is_file():
        raise Error(f"{photos / 'images' / name}: there is no such photo")
    if embeddings is not None:
        embeddings = np.asarray(embeddings, dtype=np.float32)
        if embeddings.ndim != 2 or len(embeddings) != len(masks) or not np.isfinite(embeddings).all():
            raise Error(f"{name}: {len(masks)} masks need as many rows of finite numbers as embeddings, not {embeddings.shape}")
    height, width = masks.shape[1:]
    listed = [{"segmentation": {"size": [height, width], "counts": run_lengths(mask)}} for mask in masks]
    _write(photos / "masks" / f"{name}.json", json.dumps(listed).encode())
    if embeddings is not None:
        data = io.BytesIO()
        np.save(data, embeddings)
        _write(photos / "embeddings" / f"{name}.npy", data.getvalue())


def run_lengths(mask):
    """COCO's run lengths of a mask: down each column, outside first."""
    flat = np.asarray(mask, dtype=bool).T.ravel()
    borders = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts = np.diff(np.concatenate([[0], borders, [flat.size]])).tolist()
    return [0] + counts if flat.size and flat[0] else counts


def _write(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    partial.write_bytes(data)
    partial.replace(path)


def imported(photos, masks):
    """Writes what an iterable of (name, masks) or (name, masks, embeddings) gives; returns the options that make `preprocess` read it."""
    embedded = set()
    for entry in masks:
        name, own, *embeddings = entry
        write_masks(photos, name, own, *embeddings)
        embedded.add(bool(embeddings) and embeddings[0] is not None)
    if not embedded:
        raise Error(f"{photos}: no masks were given")
    if len(embedded) > 1:
        raise Error(f"{photos}: some photos have embeddings and some have none; give them for all or for none")
    return {"segmenter": "import", "encoder": "import"} if embedded.pop() else {"segmenter": "import"}
