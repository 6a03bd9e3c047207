"""Open-vocabulary 3-D scenes: build them from photos and ask them for things by name. See README.md beside this package."""

from . import _fastlgs, own
from ._fastlgs import Answer, Camera, Error, Scene, __version__, make, synth, train
from .own import write_masks

__all__ = ["Answer", "Camera", "Error", "Scene", "__version__", "make", "preprocess", "synth", "train", "write_masks"]


def preprocess(photos, output, *, masks=None, **options):
    """Photos to masks, key points, poses and points, in the scene folder `output`.

    `masks` may be an iterable, such as a generator, of (name of a photo, masks) or (name, masks, embeddings): bool (n, height, width), and float
    (n, numbers). They are written beside the photos, and taken instead of the offline ones.
    """
    if masks is not None:
        options = {**own.imported(photos, masks), **options}
    return _fastlgs.preprocess(photos, output, **options)
