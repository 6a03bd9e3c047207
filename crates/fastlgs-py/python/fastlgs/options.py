"""Options of the stages, generated from the command line: keyword arguments of the functions."""

from os import PathLike
from typing import Any, Dict, List, Literal, Optional, Tuple, TypedDict, Union

Path = Union[str, "PathLike[str]"]


class PreprocessOptions(TypedDict, total=False):
    """Options of `fastlgs preprocess`."""

    # CLIP model, by its name in `models pull`
    clip: str

    # ONNX file of CLIP's image tower, instead of --clip
    clip_image: Path

    # ONNX file of CLIP's text tower, instead of --clip. With imported embeddings: the tower
    # that belongs to them
    clip_text: Path

    # Pixels around a mask in its crop for CLIP: grey, black, the blurred photo, or the photo
    # itself with a margin. Default: the best one by `models calibrate`, else grey; black with
    # `make --effort like-paper`
    crops: Literal["grey", "black", "blurred", "context"]

    # Encoder, which embeds masks
    encoder: Literal["offline", "clip", "import"]

    # Hold out every N-th photo (sorted by name) from training and mapping; 0 holds out none. If
    # the data set marks photos for testing, those are held out instead
    holdout: int

    # Hold out the photos that these labels name (LERF-OVS, 3D-OVS or SPIn-NeRF), instead of
    # every N-th
    holdout_labels: Path

    # Levels of masks to keep, separated by commas. Whole masks are always kept; Algorithm 1
    # uses only those
    levels: List[Literal["whole", "part", "subpart"]]

    # Limit on the longer side of prepared photos, in pixels
    max_side: int

    # Memory limit for reading photos, such as 500M or 4G
    memory: int

    # Number of neighbouring photos with which each photo is matched
    neighbours: int

    # Convention in which the poses are written. Default: the usual one of their file, unless
    # the key points clearly fit another
    pose_convention: Literal["c2w-opengl", "c2w-opencv", "w2c-opengl", "w2c-opencv", "w2c-opencv-xyzw", "c2w-opencv-xyzw"]

    # How to verify and correct poses
    poses: Literal["keep", "check", "refine"]

    # SAM model, by its name in `models pull`
    sam: str

    # ONNX file of SAM's prompt decoder, instead of --sam
    sam_decoder: Path

    # ONNX file of SAM's image encoder, instead of --sam
    sam_encoder: Path

    # Least predicted IoU of SAM's masks, instead of the preset's
    sam_iou: float

    # Number of point prompts along each side of a photo, instead of the preset's 32
    sam_points: int

    # Settings with which SAM segments a photo. Default: meta, but langsplat with `make --effort
    # like-paper`
    sam_preset: Literal["meta", "langsplat"]

    # Least stability of SAM's masks, instead of the preset's
    sam_stability: float

    # Segmenter, which finds masks
    segmenter: Literal["offline", "sam", "import"]

    # How to compute poses for photos without them
    sfm: Literal["auto", "colmap"]


class TrainOptions(TypedDict, total=False):
    """Options of `fastlgs train`."""

    # Refine the cameras of the training photos. `auto` does so if validation views improve by
    # it
    align: Literal["auto", "on", "off"]

    # Paper mapping: weight of colour in the similarity
    alpha: float

    # Anti-alias with the 2-D Mip filter. It is always on if --init names the Gaussians of this
    # scene and they were trained with it
    antialias: bool

    # Background colour: three numbers from 0 to 1 separated by commas, or `learn`. Default:
    # black; if --init names the Gaussians of this scene, the background of their training
    background: Dict[str, Any]

    # Use masks to train Gaussians to end at the borders of objects. `auto` uses masks of SAM
    # and imported ones; those of the offline segmenter only follow edges of the photos. Needs
    # --mapping global and --feature-mode lift
    borders: Literal["auto", "on", "off"]

    # Limit of Gaussians: a number, or `auto`. `auto` removes Gaussians that hardly change the
    # training photos. It allows at most one per 20 pixels of the training photos, and at most
    # 200,000 (quick), 300,000 (standard) or 1,000,000 (paper)
    budget: Optional[int]

    # Paper mapping: cues to compare in addition to embeddings, separated by commas (the
    # ablation of the paper)
    cues: List[Literal["keypoints", "color", "none"]]

    # Measure the PSNR of held-out views every N iterations, and report it over time. N is
    # rounded up to a multiple of 20
    curve: int

    # Weight of the depth loss, which keeps Gaussians on the planes that masks show; 0 for none.
    # It is used if at least 40 % of the photos have no texture, as in rooms with bare walls
    depth_weight: float

    # Learn an affine exposure for each training photo. `auto` does so if the photos' brightness
    # varies
    exposure: Literal["auto", "on", "off"]

    # How Gaussians get their codes
    feature_mode: Literal["lift", "train"]

    # Weight of the feature loss relative to the colour loss, for --feature-mode train and
    # --borders. Both losses move Gaussians, unless --freeze is set
    feature_weight: float

    # Keep geometry and colour of the --init file, and train features only
    freeze: bool

    # Start from the Gaussians of a file instead of points: .ply (including compressed files of
    # SuperSplat), .spz, .sog, .glb or .splat
    init: Path

    # Number of iterations, instead of the preset's
    iterations: int

    # How masks become objects
    mapping: Literal["global", "paper", "keep"]

    # Length of training
    preset: Literal["quick", "standard", "paper", "like-paper"]

    # Continue from the last checkpoint
    resume: bool

    # Highest spherical harmonics degree of colour, 0 to 3. Default: that of the --init file,
    # else that of the preset. With fewer than 25 training photos, it is at most 1, except with
    # like-paper
    sh_degree: int

    # Global mapping: least support of an object, its mean IoU with the best mask of each view,
    # by default 0.3 for imported masks and 0.5 for others
    support: float

    # Paper mapping: least number of key point matches that makes two masks one object
    tau: int

    # Paper mapping: least similarity that makes two masks one object. Default: 0.95 as in the
    # paper, but 0.7 for the offline encoder
    theta: float


class SynthOptions(TypedDict, total=False):
    """Options of `fastlgs synth`."""

    # Label every N-th view, so that it can be held out
    holdout: int

    # Write overlapping masks of objects and their parts as COCO lists, instead of label maps of
    # three levels
    mask_lists: bool

    # Folder of the pictures in the room, instead of the installed ones
    pictures: Path

    # Size of the photos in pixels
    size: Tuple[int, int]

    # Number of photos; by default 40 for most kinds
    views: int

    # Leave out the object of this name, as ground truth for `remove`
    without: str


class RemoveOptions(TypedDict, total=False):
    """Options of `fastlgs remove`."""

    # CLIP text tower, for scenes with imported embeddings, or if its file has moved
    clip_text: Path

    # Inpainter for regions that no photo shows: membrane (smoothest), opencv (Telea), or an
    # ONNX file such as LaMa
    inpainter: str


class EvaluateOptions(TypedDict, total=False):
    """Options of `fastlgs eval`."""

    # File of absent names, one a line, instead of the built-in list of everyday objects
    absent: Path

    # CLIP text tower, for scenes with imported embeddings, or if its file has moved
    clip_text: Path

    # Folder of true depth maps of held-out views, named as their photos: grey PNG of 16 bits,
    # or EXR in world units. 0 means unknown
    depth: Path

    # Depth in world units of one step of the PNG files of --depth. The default suits
    # millimetres in a scene in metres
    depth_unit: float

    # Accepted share of absent names that are answered, 0 to 1
    false_alarms: float

    # Name of the object in SPIn-NeRF masks, instead of the name of their folder
    label_text: str

    # Decide pixels as in the paper: largest distance of a rendered code from the code of its
    # object, on a scale of 0 to 255
    tau_ac: float
