"""Open-vocabulary 3-D scenes: build them from photos and ask them for things by name. See README.md beside this package."""

from ._fastlgs import Answer, Camera, Error, Scene, __version__, make, preprocess, synth, train

__all__ = ["Answer", "Camera", "Error", "Scene", "__version__", "make", "preprocess", "synth", "train"]
