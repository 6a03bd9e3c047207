"""End-to-end tests from Python: a generated scene is preprocessed, trained and queried."""

import json
import os
import pathlib
import re
import signal
import threading

import numpy as np
import pytest

import fastlgs


@pytest.fixture(scope="session")
def events():
    return []


@pytest.fixture(scope="session")
def scene(tmp_path_factory, events):
    photos, folder = tmp_path_factory.mktemp("photos"), tmp_path_factory.mktemp("scene")
    written = fastlgs.synth("room", photos, views=16, size=(160, 120))
    assert written["views"] == 16
    made = fastlgs.preprocess(photos, folder, segmenter="import", progress=events.append, device="cpu")
    assert made["training_photos"] == 14 and made["masks"] > 0
    trained = fastlgs.train(folder, iterations=400, budget=4000, progress=events.append, device="cpu")
    assert 0 < trained["gaussians"] <= 4000
    return fastlgs.Scene(folder, device="cpu")


def test_progress_is_told(scene, events):
    stages = {event.get("stage") for event in events}
    assert {"photos", "masks", "train", "votes", "objects"} <= stages
    steps = [event["done"] for event in events if event.get("stage") == "train" and "psnr" in event]
    assert steps == sorted(steps) and steps[-1] == 400


def test_questions_are_answered(scene):
    view = scene.held_out[0]
    cat = scene.query("cat", view=view, false_alarms=1.0)
    width, height = scene.camera(view).size
    assert cat.found and bool(cat) and cat.view == view
    assert cat.mask.shape == cat.relevancy.shape == (height, width) and cat.mask.dtype == bool
    assert cat.report["pixels"] == cat.mask.sum()
    refused = scene.query("cat", view=view, false_alarms=0.0)
    assert refused.found is False and cat.nearest == []
    assert [near["id"] for near in refused.nearest] == [c["id"] for c in refused.report["candidates"][:3]]
    assert all(near["best_view"] in scene.views for near in refused.nearest)
    # The nearest object is accepted by its id.
    assert scene.query(object=refused.nearest[0]["id"], view=view).found
    listed = scene.list_objects(names=2)
    assert sorted(o["id"] for o in listed) == [o.id for o in scene.objects]
    assert all(len(o["names"]) <= 2 for o in listed)
    # A query by a pixel finds the object that is rendered there.
    drawn = scene.render(view, "objects")
    y, x = np.argwhere(drawn > 0)[0]
    pointed = scene.query(point=(int(x), int(y)), view=view)
    assert pointed.found and pointed.mask[y, x]
    several = scene.query(point=[[int(x), int(y)], (int(x), int(y))], view=view)
    assert [o.id for o in several.objects] == [o.id for o in pointed.objects]
    # A query by a picture.
    shown = scene.query(image=scene.render(view), view=view, false_alarms=1.0)
    assert shown.text == "image"


def test_arrays_are_those_of_the_scene(scene):
    g = scene.gaussians
    n = len(g["means"])
    shapes = {"means": (n, 3), "scales": (n, 3), "rotations": (n, 4), "opacities": (n,), "features": (n, 3), "object_ids": (n,)}
    assert {name: g[name].shape for name in shapes} == shapes and g["sh"].shape[::2] == (n, 3)
    assert (g["scales"] > 0).all() and ((g["opacities"] > 0) & (g["opacities"] < 1)).all()
    np.testing.assert_allclose(np.linalg.norm(g["rotations"], axis=1), 1, atol=1e-5)
    leaf = next(o.id for o in scene.objects if o.id not in {p.parent for p in scene.objects})
    lists = scene.object_lists
    np.testing.assert_array_equal(scene.select([leaf]), np.flatnonzero([leaf in lists[i] for i in g["object_ids"]]))
    embeddings = scene.embeddings(leaf)
    assert embeddings.ndim == 2 and len(embeddings) > 0


def test_cameras_of_either_convention_agree(scene):
    view = scene.views[0]
    known = scene.camera(view)
    pose = np.linalg.inv(known.world_to_camera) @ np.diag([1.0, -1, -1, 1])
    fx, fy, cx, cy = known.intrinsics
    same = fastlgs.Camera.from_nerfstudio(pose[:3], fx, fy, *known.size, cx=cx, cy=cy)
    np.testing.assert_allclose(same.world_to_camera, known.world_to_camera, atol=1e-4)
    a, b = scene.render(known), scene.render(same)
    assert a.dtype == np.uint8 and np.abs(a.astype(int) - b).mean() < 0.5
    photo_like = scene.render(known.resized(80, 60), "depth")
    assert photo_like.shape == (60, 80) and (photo_like > 0).all()
    feature = scene.render(view, "feature")
    assert feature.shape == (known.size[1], known.size[0], 3) and feature.max() > 0.05


def test_selections_are_exported(scene, tmp_path):
    first = scene.objects[0].id
    scene.export(tmp_path / "one.ply", [first])
    scene.export(tmp_path / "rest.ply", [first], rest=True)
    assert (tmp_path / "one.ply").stat().st_size > 0 and (tmp_path / "rest.ply").stat().st_size > 0


def test_mistakes_are_named(scene, tmp_path):
    for call, words in [
        (lambda: fastlgs.Scene(tmp_path / "nowhere"), "nowhere"),
        (lambda: fastlgs.preprocess(tmp_path, tmp_path / "out", max_sides=3), "max_sides"),
        (lambda: fastlgs.preprocess(tmp_path, tmp_path / "out", max_side="large"), "max_side"),
        (lambda: fastlgs.make(tmp_path, tmp_path / "out", effort="heroic"), "heroic"),
        (lambda: scene.query(), "one way"),
        (lambda: scene.query(" "), "empty"),
        (lambda: scene.query("cat", view="nowhere.png"), "nowhere.png"),
        (lambda: scene.render(what="smell"), "smell"),
        (lambda: scene.embeddings(9999), "9999"),
        (lambda: scene.export(tmp_path / "scene.xyz"), "scene.xyz"),
        (lambda: fastlgs.Camera(0, 10, 1, 1, np.eye(4)), "0x10"),
    ]:
        with pytest.raises(fastlgs.Error, match=words):
            call()


def test_what_does_not_exist_is_not_found(scene, tmp_path):
    for call in [
        lambda: scene.query("cat", view="nowhere.png"),
        lambda: scene.embeddings(9999),
        lambda: scene.teach("x", object=9999),
        lambda: scene.remove(tmp_path / "without", object=9999),
        lambda: scene.forget("never taught"),
    ]:
        with pytest.raises(fastlgs.NotFound):
            call()


def test_names_are_taught_and_forgotten(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("FASTLGS_DATA", str(tmp_path))
    example = scene.objects[0]
    taught = scene.teach("Kocur", object=example.id)
    assert taught["name"] == "kocur" and [row["name"] for row in scene.names()] == ["kocur"]
    assert scene.query("kocur", false_alarms=1.0).objects[0].id == example.id
    scene.forget("kocur")
    assert scene.names() == []


def test_an_object_is_removed_and_the_scene_evaluated(scene, tmp_path):
    largest = max(scene.objects, key=lambda o: o.area)
    removed = scene.remove(tmp_path / "without", object=largest.id)
    assert largest.id in removed["objects"] and removed["removed"] > 0
    assert scene.evaluate()["psnr"] > 15
    with fastlgs.Scene(tmp_path / "without", device="cpu") as without:
        assert len(without.objects) < len(scene.objects)
    with pytest.raises(fastlgs.Error, match="closed"):
        without.query("cat")


def test_false_from_the_callback_cancels_a_stage(scene):
    with pytest.raises(fastlgs.Cancelled):
        fastlgs.train(scene.path, iterations=200_000, device="cpu", progress=lambda event: False)


def test_stubs_name_what_the_package_has():
    stub = (pathlib.Path(fastlgs.__file__).parent / "__init__.pyi").read_text()
    for name in fastlgs.__all__:
        assert re.search(rf"^(class|def) {name}\b|^{name}:", stub, re.M), name
    for name in dir(fastlgs.Scene):
        if not name.startswith("_"):
            assert re.search(rf"^    def {name}\(", stub, re.M), name


def test_ctrl_c_and_a_callback_that_raises_end_a_stage(scene, tmp_path):
    folder = scene.path
    interrupt = threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT))
    interrupt.start()
    with pytest.raises(KeyboardInterrupt):
        fastlgs.train(folder, iterations=200_000, device="cpu")

    class Enough(Exception):
        pass

    def stop(event):
        if event.get("stage") == "train":
            raise Enough

    with pytest.raises(Enough):
        fastlgs.train(folder, iterations=200_000, progress=stop, device="cpu")
    # The earlier result is unchanged.
    assert fastlgs.Scene(folder, device="cpu").views == scene.views


def test_other_threads_go_on(scene):
    counts = []
    done = threading.Event()

    def count():
        while not done.is_set():
            counts.append(1)

    thread = threading.Thread(target=count)
    thread.start()
    answers = [scene.query("cat", view=view) for view in scene.views]
    done.set()
    thread.join()
    assert len(answers) == len(scene.views) and len(counts) > 100


def test_own_masks_and_embeddings(scene, tmp_path):
    """Masks and embeddings come from the caller, as from a segmenter and CLIP in Python."""
    photos = tmp_path / "photos"
    fastlgs.synth("room", photos, views=16, size=(160, 120))
    largest = sorted(scene.objects, key=lambda o: -o.area)[:6]
    things = {f"thing {k}": o.id for k, o in enumerate(largest)}
    drawn = {name: scene.render(name, "objects") for name in scene.views}

    # The last number is what all objects have in common with "object", "stuff" and "texture".
    common = {*things, "object", "stuff", "texture"}

    def embed_text(texts):
        rows = [[float(text == name) for name in things] + [0.5 * (text in common)] for text in texts]
        return np.array(rows, dtype=np.float32)

    def own():
        for view, ids in drawn.items():
            there = {name: ids == id for name, id in things.items() if (ids == id).sum() > 20}
            yield view, np.stack(list(there.values())), embed_text(list(there))

    folder = tmp_path / "scene"
    made = fastlgs.preprocess(photos, folder, masks=own(), device="cpu")
    assert made["masks"] > made["training_photos"]
    fastlgs.train(folder, iterations=400, budget=4000, device="cpu")
    asked = fastlgs.Scene(folder, device="cpu", embed_text=embed_text)
    right = 0
    for name, id in things.items():
        view = max(drawn, key=lambda view: (drawn[view] == id).sum())
        answer, truth = asked.query(name, view=view), drawn[view] == id
        iou = (answer.mask & truth).sum() / (answer.mask | truth).sum()
        right += iou > 0.5
    assert right >= len(things) - 2, f"{right} of {len(things)}"
    assert not asked.query("nothing of the kind"), "its embedding is similar to no object"
    with pytest.raises(fastlgs.Error, match="no such photo"):
        fastlgs.write_masks(photos, "none.png", np.zeros((1, 4, 4), dtype=bool))
    with pytest.raises(fastlgs.Error, match="2 masks need as many rows"):
        fastlgs.write_masks(photos, "000.png", np.zeros((2, 4, 4), dtype=bool), np.zeros((1, 8)))
    with pytest.raises(fastlgs.Error, match="float32 of \\(texts, numbers\\)"):
        fastlgs.Scene(folder, device="cpu", embed_text=lambda texts: "no array").query("thing 0")


def test_numpys_numbers_are_options_and_poses(scene, tmp_path):
    written = fastlgs.synth("table", tmp_path / "photos", views=np.int64(8), size=np.array([64, 48]))
    assert written["views"] == 8 and written["size"] == "64x48"
    camera = scene.camera(scene.views[0])
    pose = camera.world_to_camera.astype(np.float32)
    again = fastlgs.Camera(*camera.size, *map(np.float32, camera.intrinsics[:2]), pose)
    assert np.allclose(again.world_to_camera, camera.world_to_camera, atol=1e-6)
    with pytest.raises(fastlgs.Error, match="object"):
        fastlgs.synth("table", tmp_path / "none", views=object())


def test_masks_are_of_all_photos(tmp_path):
    photos = tmp_path / "photos"
    fastlgs.synth("table", photos, views=8, size=(64, 48))
    whole = np.ones((1, 48, 64), dtype=bool)
    names = sorted(path.name for path in (photos / "images").iterdir())
    with pytest.raises(fastlgs.Error, match="3 photos have no masks"):
        fastlgs.preprocess(photos, tmp_path / "scene", masks={name: whole for name in names[:5]})
    for wrong in ({0: whole}, [whole], 5):
        with pytest.raises(fastlgs.Error, match="masks are"):
            fastlgs.preprocess(photos, tmp_path / "scene", masks=wrong)
    assert not (tmp_path / "scene").exists()
    made = fastlgs.preprocess(photos, tmp_path / "scene", masks={name: whole for name in names}, holdout=0, device="cpu")
    assert made["masks"] == 8


def test_a_forked_child_raises_at_once(scene):
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            scene.query("cat")
            said = "no error"
        except fastlgs.Error as error:
            said = str(error)
        os.write(writing, said.encode())
        os._exit(0)
    os.waitpid(child, 0)
    assert "spawn" in os.read(reading, 1000).decode()


def test_run_lengths_go_down_columns():
    from fastlgs.own import run_lengths

    mask = np.array([[1, 0], [1, 1], [0, 0]], dtype=bool)
    assert run_lengths(mask) == [0, 2, 2, 1, 1]
    assert run_lengths(np.zeros((2, 2), dtype=bool)) == [4]


def test_the_notebook_runs(tmp_path, monkeypatch):
    notebook = pathlib.Path(__file__).parents[1] / "examples" / "photos_to_answers.ipynb"
    monkeypatch.chdir(tmp_path)
    names = {}
    for cell in json.loads(notebook.read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["cat"].mask.any() and names["answer"].report
