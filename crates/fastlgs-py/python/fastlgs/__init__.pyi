import pathlib
from typing import Any, Callable, Dict, Iterable, List, Literal, Mapping, Optional, Sequence, Tuple, Union

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from .options import EvaluateOptions, Path, PreprocessOptions, RemoveOptions, SynthOptions, TrainOptions

__version__: str

View = Union[str, "Camera"]
Progress = Callable[[Dict[str, Any]], object]
"""Receives {"stage", "done", "total", "note"} or {"warning"}. Returning False cancels the stage.

Events of training have "loss", "psnr" and "gaussians" instead of "note".
"""

class Error(Exception):
    """An error of the pipeline: one sentence that names the file and the solution."""

class NotFound(Error):
    """A view, object or name that does not exist."""

class Cancelled(Error):
    """The progress callback cancelled the stage."""

class Object:
    """An object or part of a scene."""

    id: int
    parent: int
    """Id of the object that it is a part of; 0 for none."""
    support: float
    """Mean IoU with the best mask of each view, 0 to 1."""
    views: int
    """Number of views that show it."""
    area: float
    """Largest share of a photo."""
    code: Tuple[float, float, float]

class FoundObject:
    """An object of an answer."""

    id: int
    parent: int
    support: float
    score: float
    """0 to 1."""
    bbox2d: Optional[Tuple[int, int, int, int]]
    """Left, top, right and bottom in pixels of the view, the last two exclusive."""
    bbox3d: Optional[Tuple[List[float], List[float]]]
    """Minimum and maximum corner in world coordinates, without outliers."""
    pixels: int
    gaussians: int

class Camera:
    """An undistorted pinhole camera: x right, y down, looking along +z (OpenCV)."""

    def __init__(
        self,
        width: int,
        height: int,
        fx: float,
        fy: float,
        world_to_camera: NDArray[np.float64],
        cx: Optional[float] = None,
        cy: Optional[float] = None,
        name: str = "camera",
    ) -> None: ...
    @staticmethod
    def from_nerfstudio(
        camera_to_world: NDArray[np.float64],
        fx: float,
        fy: float,
        width: int,
        height: int,
        cx: Optional[float] = None,
        cy: Optional[float] = None,
        name: str = "camera",
    ) -> "Camera":
        """Creates a camera from a pose of nerfstudio or OpenGL, (3, 4) or (4, 4).

        The pose is camera to world, with x right, y up, looking along -z.
        """
    @property
    def name(self) -> str: ...
    @property
    def size(self) -> Tuple[int, int]:
        """Width and height in pixels."""
    @property
    def intrinsics(self) -> Tuple[float, float, float, float]:
        """fx, fy, cx, cy in pixels."""
    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """World-to-camera matrix, (4, 4)."""
    def resized(self, width: int, height: int) -> "Camera": ...

class Answer:
    """The answer to a query in one view. It is true if something was found."""

    @property
    def text(self) -> str: ...
    @property
    def found(self) -> bool: ...
    @property
    def confidence(self) -> float:
        """Score of the best object, 0 to 1: share of absent names whose best score is lower."""
    @property
    def view(self) -> str: ...
    @property
    def seen_best(self) -> Optional[str]:
        """Name of the view that shows most of the answer, if this view hardly shows it."""
    @property
    def mask(self) -> NDArray[np.bool_]:
        """Mask of the answer, (height, width)."""
    @property
    def relevancy(self) -> NDArray[np.float32]:
        """Confidence of the object at each pixel, 0 to 1; (height, width)."""
    @property
    def objects(self) -> List[FoundObject]: ...
    @property
    def nearest(self) -> List[Dict[str, Any]]:
        """Nearest objects if nothing was found, at most three: id, score and best_view of each."""
    @property
    def report(self) -> Dict[str, Any]:
        """The report of the answer, as `fastlgs query --json` prints it."""
    def __bool__(self) -> bool: ...

class Scene:
    """A trained scene folder, opened on a device.

    Calls release the GIL, so that other threads continue. Calls on one scene run one after another.
    """

    def __init__(
        self,
        path: Path,
        *,
        device: str = "auto",
        clip_text: Optional[Path] = None,
        embed_text: Optional[Callable[[List[str]], NDArray[np.float32]]] = None,
    ) -> None:
        """Opens a trained scene folder.

        `embed_text` replaces the text encoder, for scenes with imported embeddings. It takes a list
        of str and returns float32 (texts, numbers).
        """
    @property
    def path(self) -> pathlib.Path: ...
    @property
    def device(self) -> str: ...
    @property
    def views(self) -> List[str]: ...
    @property
    def held_out(self) -> List[str]: ...
    def camera(self, view: View) -> Camera: ...
    def query(
        self,
        text: Optional[str] = None,
        *,
        view: Optional[View] = None,
        point: Union[None, Tuple[int, int], Sequence[Tuple[int, int]]] = None,
        image: Optional[NDArray[np.uint8]] = None,
        object: Optional[int] = None,
        negatives: Sequence[str] = (),
        false_alarms: Optional[float] = None,
        top_k: Optional[int] = None,
    ) -> Answer:
        """Finds objects by a text, by pixels of the view, by a picture, or by the id of an object.

        `point` is one pixel (x, y), or several pixels of one object. `image` is uint8
        (height, width, 3).
        """
    @property
    def objects(self) -> List[Object]:
        """All objects and parts."""
    def list_objects(self, names: int = 3) -> List[Dict[str, Any]]:
        """Lists all objects and parts with their likeliest names, the largest first.

        Each has the fields that `fastlgs objects --json` prints.
        """
    def embeddings(self, id: int) -> NDArray[np.float32]:
        """Returns the embeddings of an object's masks, (masks, numbers).

        Embeddings of the offline encoder have 384 numbers for texts, and 12 for colours and
        materials. Further 64 numbers are compared only between objects, examples and pictures.
        """
    def render(self, view: Optional[View] = None, what: Literal["color", "depth", "feature", "objects"] = "color") -> NDArray[Any]:
        """Renders a view.

        `color` is uint8 (h, w, 3), `depth` float32 (h, w) in world units, `feature` float32
        (h, w, 3), and `objects` uint16 (h, w).
        """
    @property
    def object_lists(self) -> List[List[int]]:
        """Objects of each value of the Gaussians' object_ids, 0 included, from small to large.

        A Gaussian may belong to several objects, since objects may overlap.
        """
    @property
    def gaussians(self) -> Dict[str, NDArray[Any]]:
        """All Gaussians as arrays.

        means (n, 3), scales (n, 3), rotations (n, 4), opacities (n), sh (n, k, 3),
        features (n, 3), object_ids (n). Means and scales are in world units; rotations are
        (w, x, y, z).
        """
    def select(self, ids: Sequence[int]) -> NDArray[np.uint32]:
        """Returns the indices of the Gaussians of objects and their parts, ascending."""
    def export(self, path: Path, ids: Optional[Sequence[int]] = None, *, rest: bool = False) -> None:
        """Writes the Gaussians of objects, or with `rest` all others, as .ply, .spz, .sog or .glb.

        Without `ids`, writes all Gaussians.
        """
    def remove(
        self,
        output: Path,
        text: Optional[str] = None,
        *,
        object: Optional[int] = None,
        progress: Optional[Progress] = None,
        **options: Unpack[RemoveOptions],
    ) -> Dict[str, Any]:
        """Removes an object, by a text or its id, fills the gap, and writes a new scene folder.

        Raises NotFound if there is no such object.
        """
    def evaluate(
        self,
        labels: Optional[Path] = None,
        *,
        progress: Optional[Progress] = None,
        **options: Unpack[EvaluateOptions],
    ) -> Dict[str, Any]:
        """Measures colour, and with a folder of labels the masks of queries, on held-out views."""
    def teach(
        self,
        name: str,
        *,
        object: Optional[int] = None,
        point: Union[None, Tuple[int, int], Sequence[Tuple[int, int]]] = None,
        view: Optional[str] = None,
        image: Optional[Path] = None,
    ) -> Dict[str, Any]:
        """Teaches a name by one example: an object id, pixels of a view, or a picture file.

        Later queries find it, in all scenes with the same encoder.
        """
    def names(self) -> List[Dict[str, Any]]:
        """Lists the taught names: name, examples, views and from."""
    def forget(self, name: str) -> None:
        """Removes a taught name and its examples."""
    def close(self) -> None:
        """Frees the device and the memory of the scene. Later calls raise Error.

        A `with` statement closes the scene at its end.
        """
    def __enter__(self) -> "Scene": ...
    def __exit__(self, *exception: Any) -> None: ...

def make(
    photos: Path,
    output: Path,
    *,
    progress: Optional[Progress] = None,
    device: str = "auto",
    seed: int = 0,
    effort: Optional[Literal["quick", "standard", "paper", "like-paper"]] = None,
    **options: Unpack[PreprocessOptions],
) -> Dict[str, Any]:
    """Makes a queryable scene from photos.

    Options are those of `fastlgs make`, with underscores.
    """

OwnMasks = Union[
    Tuple[str, NDArray[np.bool_]],
    Tuple[str, NDArray[np.bool_], Optional[NDArray[np.float32]]],
]
"""Name of a photo, its masks (n, height, width), which may overlap, and embeddings (n, numbers)."""

def preprocess(
    photos: Path,
    output: Path,
    *,
    masks: Optional[Union[Iterable[OwnMasks], Mapping[str, Any]]] = None,
    progress: Optional[Progress] = None,
    device: str = "auto",
    seed: int = 0,
    **options: Unpack[PreprocessOptions],
) -> Dict[str, Any]:
    """Computes masks, key points, poses and points from photos.

    Options are those of `fastlgs preprocess`, with underscores.

    `masks` has masks of all photos. They are written beside the photos and used instead of those of
    the offline models. A dict has names of photos as keys, and masks or (masks, embeddings) as
    values.
    """

def write_masks(
    photos: Path, name: str, masks: NDArray[np.bool_], embeddings: Optional[NDArray[np.float32]] = None
) -> None:
    """Writes the masks of a photo, and an embedding for each, for import by `preprocess`."""

def train(scene: Path, *, progress: Optional[Progress] = None, device: str = "auto", seed: int = 0, **options: Unpack[TrainOptions]) -> Dict[str, Any]:
    """Trains Gaussians and finds objects.

    Options are those of `fastlgs train`, with underscores.
    """

def synth(
    kind: str, output: Path, *, progress: Optional[Progress] = None, device: str = "auto", seed: int = 0, **options: Unpack[SynthOptions]
) -> Dict[str, Any]:
    """Generates photos with exact poses, depths and masks.

    Options are those of `fastlgs synth`, with underscores.
    """
