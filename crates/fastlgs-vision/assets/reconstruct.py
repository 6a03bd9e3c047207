"""Structure from motion with pycolmap: PHOTOS/images -> the model of most photos, as COLMAP's binary files."""

import pathlib
import sys

import pycolmap

images, work, camera_model = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), sys.argv[3]
database = work / "database.db"
print("features", flush=True)
if hasattr(pycolmap, "ImageReaderOptions"):
    how = {"reader_options": pycolmap.ImageReaderOptions(camera_model=camera_model)}
else:
    # Versions before 0.5 take the model itself.
    how = {"camera_model": camera_model}
pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, **how)
print("matches", flush=True)
pycolmap.match_exhaustive(database)
print("mapping", flush=True)
(work / "sparse").mkdir(exist_ok=True)
pycolmap.incremental_mapping(database, images, work / "sparse")
