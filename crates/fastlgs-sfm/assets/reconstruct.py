"""Poses of photos from their matched key points, with pycolmap: FOLDER/features.json and .bin -> FOLDER/sparse/0 (COLMAP's binary files).

features.json: images (name, path of the photo, width, height, key points, and where the lens is known fx, fy, cx, cy), pairs (a, b, matches), seed,
camera_model. features.bin holds, in that order, the key points of each image (x, y as 32-bit floats) and the matches of each pair (two 32-bit numbers
each). Where lenses are known FOLDER/poses.json is all that is written: three rows of [R t] for each image of the model that explains most, null for
others."""

import json
import pathlib
import sys

import numpy
import pycolmap

# Up to so many photos are placed one by one as well as all at once, and what explains more key points counts. More are placed all at once, and one by
# one only where that leaves out more than a tenth.
ONE_BY_ONE, PLACED = 150, 0.9
# With so many photos of a lens, and so many points in each of them, its principal point and all four distortion terms of OpenCV's model are
# found as well; fewer leave them open (with 33 points a photo the focal length was wrong by 5 %). Nor do fewer matches tell a focal length by pairs.
WELL_SEEN, POINTS = 20, 200
# Points with a larger error in pixels, or a smaller angle in degrees between their rays, are left out of that.
MAX_ERROR, MIN_ANGLE = 2.0, 1.5
# A lens whose focal length is not between these shares of the photo's longer side is none that there is, but for the longest.
FOCAL = 0.3, 4.0
# A principal point farther from the middle, as a share of the photo's size, is no lens that there is.
MAX_OFFSET = 0.1

work = pathlib.Path(sys.argv[1])
plan = json.loads((work / "features.json").read_text())
data = numpy.fromfile(work / "features.bin", dtype=numpy.uint32)
place = 0


def take(rows):
    global place
    place += 2 * rows
    return data[place - 2 * rows : place].reshape(rows, 2)


def camera_of(image):
    """All photos of one size come from one lens; what the file tells of its focal length is where the search starts."""
    size, focal, known = max(image["width"], image["height"]), 1.2, False
    try:
        told = pycolmap.infer_camera_from_image(image["path"])
        focal, known = told.mean_focal_length() / max(told.width, told.height), told.has_prior_focal_length
    except Exception as error:
        print(f"no focal length in {image['name']}: {error}", flush=True)
    model = getattr(pycolmap.CameraModelId, plan["camera_model"])
    camera = pycolmap.Camera.create_from_model_id(1, model, focal * size, image["width"], image["height"])
    camera.has_prior_focal_length = known
    return camera


def alias(k):
    """The list of pairs is split at spaces, which names of photos may have."""
    return f"{k:06}" + pathlib.Path(plan["images"][k]["path"]).suffix


lenses_are_known = all("lens" in image for image in plan["images"])


def lens_of(image):
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.PINHOLE, image["lens"][0], image["width"], image["height"])
    camera.params = image["lens"]
    camera.has_prior_focal_length = True
    return camera


images = work / "images"
images.mkdir()
for k, image in enumerate(plan["images"]):
    (images / alias(k)).symlink_to(image["path"])

database = pycolmap.Database.open(work / "database.db")
cameras, ids = {}, []
for image in plan["images"]:
    size = (image["width"], image["height"], *image.get("lens", []))
    if size not in cameras:
        camera = lens_of(image) if lenses_are_known else camera_of(image)
        camera.camera_id = database.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(camera.sensor_id)
        cameras[size] = (camera, database.write_rig(rig))
    camera, rig_id = cameras[size]
    entry = pycolmap.Image(name=alias(len(ids)), camera_id=camera.camera_id)
    image_id = database.write_image(entry)
    entry.image_id = image_id
    frame = pycolmap.Frame()
    frame.rig_id = rig_id
    frame.add_data_id(entry.data_id)
    database.write_frame(frame)
    database.write_keypoints(image_id, take(image["keypoints"]).view(numpy.float32))
    ids.append(image_id)
with open(work / "pairs.txt", "w") as listed:
    for pair in plan["pairs"]:
        database.write_matches(ids[pair["a"]], ids[pair["b"]], take(pair["matches"]))
        listed.write(f"{alias(pair['a'])} {alias(pair['b'])}\n")
database.close()


def verify():
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = plan["seed"]
    verification.ransac.max_error = 2.0
    verification.ransac.max_num_trials = 2000
    pycolmap.verify_matches(work / "database.db", work / "pairs.txt", verification)


def calibrate():
    """Focal lengths that no photo tells, by the fundamental matrices of all pairs together (Fetzer et al. 2020). A guess misleads who places by it."""
    database = pycolmap.Database.open(work / "database.db")
    agreeing = sum(len(geometry.inlier_matches) for geometry in database.read_two_view_geometries()[1])
    database.close()
    if 2 * agreeing < POINTS * len(ids):
        print(f"{agreeing} matches of {len(ids)} photos are too few to tell focal lengths", flush=True)
        return
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = plan["seed"]
    options.reestimate_relative_pose = False
    pycolmap.calibrate_view_graph(work / "database.db", options)
    database = pycolmap.Database.open(work / "database.db")
    for camera, _ in cameras.values():
        if camera.has_prior_focal_length:
            continue
        # Sums of several threads differ in their last digits.
        focal = round(float(database.read_camera(camera.camera_id).params[0]), 1)
        # A guess that no pair moved was not confirmed.
        if FOCAL[0] < focal / max(camera.width, camera.height) < FOCAL[1] and abs(focal / camera.params[0] - 1.0) > 1e-3:
            camera.params = [focal, *camera.params[1:]]
            camera.has_prior_focal_length = True
            print(f"a focal length of {focal} pixels", flush=True)
        database.update_camera(camera)
    database.clear_two_view_geometries()
    database.close()
    verify()


print("verification", flush=True)
verify()
if not lenses_are_known and not all(camera.has_prior_focal_length for camera, _ in cameras.values()):
    print("focal lengths", flush=True)
    calibrate()


def all_at_once():
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = plan["seed"]
    # More threads would sum in another order each time.
    options.num_threads = options.mapper.num_threads = 1
    options.mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    options.mapper.rotation_averaging.random_seed = options.mapper.global_positioning.random_seed = plan["seed"]
    if lenses_are_known:
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = False
    return list(pycolmap.global_mapping(work / "database.db", images, work, options).values())


def one_by_one():
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = plan["seed"]
    options.num_threads = 1
    return list(pycolmap.incremental_mapping(work / "database.db", images, work, options).values())


def explained(model):
    return model.compute_num_observations()


failures = []


def tried(way):
    """What one way of placing gives; nothing where it fails, as the other may not."""
    try:
        models = [model for model in way() if model.num_reg_images()]
        for model in models:
            print(f"{way.__name__}: {model.num_reg_images()} photos, {explained(model)} key points explained", flush=True)
        return models
    except Exception as error:
        failures.append(f"{way.__name__} failed: {error}")
        print(failures[-1], flush=True)
        return []


print("mapping", flush=True)
if lenses_are_known:
    # Other photos of the same scene misled whoever placed them one by one; all at once, a few wrong pairs are outvoted.
    best = max(all_at_once(), key=explained, default=None)
    placed = {image.image_id: image for image in best.images.values() if image.has_pose} if best else {}
    poses = [placed[i].cam_from_world().matrix() if i in placed else None for i in ids]
    poses = [pose.tolist() if pose is not None and numpy.isfinite(pose).all() else None for pose in poses]
    (work / "poses.json").write_text(json.dumps(poses))
    print(f"{len(placed)} of {len(ids)} photos placed", flush=True)
    sys.exit()
models = tried(all_at_once)
if len(ids) <= ONE_BY_ONE or max((model.num_reg_images() for model in models), default=0) < PLACED * len(ids):
    print("mapping in another way", flush=True)
    models += tried(one_by_one)
best = max(models, key=explained, default=None)


def calibrated(model):
    """The model with the whole lens adjusted; as it was where that does not fit better."""
    refined = pycolmap.Reconstruction(model)
    for camera in refined.cameras.values():
        focal, cx, cy, radial = camera.params
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [focal, focal, cx, cy, radial, 0.0, 0.0, 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.ceres.solver_options.num_threads = 1
    for _ in range(3):
        pycolmap.bundle_adjustment(refined, options)
        pycolmap.ObservationManager(refined).filter_all_points3D(MAX_ERROR, MIN_ANGLE)
    refined.update_point_3d_errors()
    for camera in refined.cameras.values():
        offset = numpy.abs(camera.params[2:4] / numpy.array([camera.width, camera.height]) - 0.5)
        if not numpy.isfinite(camera.params).all() or offset.max() > MAX_OFFSET:
            return model
    kept = pycolmap.Reconstruction(model)
    pycolmap.ObservationManager(kept).filter_all_points3D(MAX_ERROR, MIN_ANGLE)
    kept.update_point_3d_errors()
    better = refined.compute_mean_reprojection_error() < kept.compute_mean_reprojection_error()
    return refined if better and refined.num_points3D() > model.num_points3D() / 2 else model


if best is None:
    sys.exit("; ".join(failures) or 0)
print("calibration", flush=True)
if best.num_reg_images() >= WELL_SEEN * len(cameras) and explained(best) >= POINTS * best.num_reg_images():
    best = calibrated(best)
for image in best.images.values():
    image.name = plan["images"][ids.index(image.image_id)]["name"]
folder = work / "sparse" / "0"
folder.mkdir(parents=True)
best.write(folder)
print(f"{best.num_reg_images()} of {len(ids)} photos placed, {best.num_points3D()} points", flush=True)
