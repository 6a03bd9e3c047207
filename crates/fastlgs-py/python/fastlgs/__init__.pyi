import pathlib
from os import PathLike
from typing import Any, Callable, Dict, Iterable, List, Literal, Mapping, Optional, Sequence, Tuple, Union

import numpy as np
from numpy.typing import NDArray

__version__: str

Path = Union[str, "PathLike[str]"]
View = Union[str, "Camera"]
Progress = Callable[[Dict[str, Any]], object]
"""Hears {"stage", "done", "total", "note"}, while training also "loss", "psnr" and "gaussians", or {"warning"}."""

class Error(Exception):
    """What went wrong, in one sentence that names the file and the mend."""

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
        """From a pose as nerfstudio and OpenGL have it: camera to world, x right, y up, looking along -z; (3, 4) or (4, 4)."""
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
        """(4, 4)."""
    def resized(self, width: int, height: int) -> "Camera": ...

class Answer:
    """What a question was answered with, in one view. True where something was found."""

    @property
    def text(self) -> str: ...
    @property
    def found(self) -> bool: ...
    @property
    def confidence(self) -> float:
        """The share of absent names whose best score is lower."""
    @property
    def view(self) -> str: ...
    @property
    def seen_best(self) -> Optional[str]:
        """The view that shows the answer best, where this one hardly does."""
    @property
    def mask(self) -> NDArray[np.bool_]:
        """(height, width)."""
    @property
    def relevancy(self) -> NDArray[np.float32]:
        """Confidence of the object that each pixel shows, 0 to 1; (height, width)."""
    @property
    def objects(self) -> List[Dict[str, Any]]:
        """id, parent, support, score, bbox2d, bbox3d, pixels, gaussians."""
    @property
    def report(self) -> Dict[str, Any]:
        """The same as `fastlgs query --json` prints."""
    def __bool__(self) -> bool: ...

class Scene:
    """A trained scene folder, opened on a device. Python goes on while it works; one thing is done at a time."""

    def __init__(
        self,
        path: Path,
        *,
        device: str = "auto",
        clip_text: Optional[Path] = None,
        embed_text: Optional[Callable[[List[str]], NDArray[np.float32]]] = None,
    ) -> None:
        """`embed_text` embeds texts where the masks were embedded by a model of the caller's: a list of str to (texts, numbers)."""
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
        negatives: Sequence[str] = (),
        false_alarms: Optional[float] = None,
        top_k: Optional[int] = None,
    ) -> Answer:
        """Asks for a text, for what a pixel of the view (or several of one thing) shows, or for what a picture (uint8, (height, width, 3)) shows."""
    @property
    def objects(self) -> List[Dict[str, Any]]:
        """id, parent (0 for none), support, views, area (largest share of a photo), code."""
    def embeddings(self, id: int) -> NDArray[np.float32]:
        """(views, numbers): with the offline encoder 384 that texts are compared by, 12 colours and materials, 64 more that count between objects, examples and pictures."""
    def render(self, view: Optional[View] = None, what: Literal["color", "depth", "feature", "objects"] = "color") -> NDArray[Any]:
        """color uint8 (h, w, 3), depth float32 (h, w) in units of the scene, feature float32 (h, w, 3), objects uint16 (h, w)."""
    @property
    def object_lists(self) -> List[List[int]]:
        """For each of the Gaussians' object_ids, 0 included, the objects that it stands for, from small to large: objects may overlap."""
    @property
    def gaussians(self) -> Dict[str, NDArray[Any]]:
        """means, scales (n, 3), rotations (n, 4) as (w, x, y, z), opacities (n), sh (n, k, 3), features (n, 3), object_ids (n)."""
    def select(self, ids: Sequence[int]) -> NDArray[np.uint32]:
        """Places of the Gaussians of some objects and their parts, rising."""
    def export(self, path: Path, ids: Optional[Sequence[int]] = None, *, rest: bool = False) -> None:
        """Writes the Gaussians of some objects, or with `rest` all others, as .ply, .spz, .sog or .glb."""

def make(
    photos: Path,
    output: Path,
    *,
    progress: Optional[Progress] = None,
    device: str = "auto",
    seed: int = 0,
    effort: Optional[Literal["quick", "standard", "paper", "like-paper"]] = None,
    **options: Any,
) -> Dict[str, Any]:
    """From photos to a scene that answers, with an effort. Options are those of `fastlgs make`, with underscores."""

OwnMasks = Union[
    Tuple[str, NDArray[np.bool_]],
    Tuple[str, NDArray[np.bool_], Optional[NDArray[np.float32]]],
]
"""The name of a photo, its masks (n, height, width), which may overlap, and their embeddings (n, numbers)."""

def preprocess(
    photos: Path,
    output: Path,
    *,
    masks: Optional[Union[Iterable[OwnMasks], Mapping[str, Any]]] = None,
    progress: Optional[Progress] = None,
    device: str = "auto",
    seed: int = 0,
    **options: Any,
) -> Dict[str, Any]:
    """Photos to masks, key points, poses and points. Options are those of `fastlgs preprocess`, with underscores.

    `masks`, of all photos, are written beside the photos and taken instead of the offline ones. A dict has the names of the photos as keys, and
    masks or (masks, embeddings) as values.
    """

def write_masks(
    photos: Path, name: str, masks: NDArray[np.bool_], embeddings: Optional[NDArray[np.float32]] = None
) -> None:
    """Keeps the masks of one photo, and an embedding for each, where `preprocess` imports them from."""

def train(scene: Path, *, progress: Optional[Progress] = None, device: str = "auto", seed: int = 0, **options: Any) -> Dict[str, Any]:
    """Gaussians with colour and objects. Options are those of `fastlgs train`, with underscores."""

def synth(
    kind: str, output: Path, *, progress: Optional[Progress] = None, device: str = "auto", seed: int = 0, **options: Any
) -> Dict[str, Any]:
    """A generated scene with exact poses, depths and masks. Options are those of `fastlgs synth`, with underscores."""
