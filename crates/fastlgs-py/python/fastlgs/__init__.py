"""Open-vocabulary 3-D scenes: build them from photos, and find objects in them by text."""

from . import _fastlgs, own
from ._fastlgs import (
    Answer,
    Camera,
    Cancelled,
    Error,
    FoundObject,
    NotFound,
    Object,
    Scene,
    __version__,
    make,
    synth,
    train,
)
from .own import write_masks

__all__ = [
    "Answer",
    "Camera",
    "Cancelled",
    "Error",
    "FoundObject",
    "NotFound",
    "Object",
    "Scene",
    "__version__",
    "make",
    "preprocess",
    "synth",
    "train",
    "write_masks",
]


def preprocess(photos, output, *, masks=None, **options):
    """Computes masks, key points, poses and points from photos, in the scene folder `output`.

    `masks` is an iterable, such as a generator, of (name of a photo, masks) or (name, masks,
    embeddings). Masks are bool (n, height, width), embeddings float (n, numbers). They are written
    beside the photos and used instead of those of the offline models.
    """
    if masks is not None:
        options = {**own.imported(photos, masks), **options}
    return _fastlgs.preprocess(photos, output, **options)
