"""Inputs of the reference programs, and scaling of random weights for useful outputs."""

import json

import numpy as np
import torch
from PIL import Image

FILTERS = {"points_per_side": 6, "predicted_iou": 0.8, "stability": 0.75, "crop_layers": 1}
POINTS = np.array([[250.0, 300.0], [770.0, 510.0], [50.0, 50.0], [970.0, 710.0], [512.0, 384.0]])


def photo():
    """Returns colour waves with two rectangles. 1024 pixels wide, so that SAM does not resize it."""
    y, x = np.mgrid[0:768, 0:1024]
    waves = [127 + 100 * np.sin(x / 100), 127 + 100 * np.sin(y / 90 + 1), 127 + 100 * np.sin((x + y) / 150)]
    picture = np.stack(waves, -1).astype(np.uint8)
    picture[200:500, 130:450] = [220, 30, 30]
    picture[380:660, 640:920] = [20, 40, 220]
    return picture


def detailed():
    """Returns a square with details finer than the input of CLIP and SigLIP, to test resizing."""
    y, x = np.mgrid[0:420, 0:420]
    return np.stack([127 + 60 * np.sin(x * x / 900), 127 + 60 * np.sin(y / 3), np.where((x // 7 + y // 5) % 2, 160, 90)], -1).astype(np.uint8)


def framed(picture):
    """Returns the picture with a grey margin on each side, 1/20 of its size in total."""
    cut = np.full((441, 441, 3), 127, np.uint8)
    cut[11:431, 11:431] = picture
    return cut


def lively(points, hyper, upscaling, score):
    """Scales random weights, which otherwise give logits near zero and equal masks for all prompts.

    Makes the upscaling layers smooth.
    """
    with torch.no_grad():
        for layer in hyper:
            layer.weight.mul_(150)
            layer.bias.mul_(150)
        for layer in upscaling:
            layer.weight.copy_(layer.weight[:, :, :1, :1].expand_as(layer.weight))
        for embedding in points:
            embedding.weight.mul_(3)
        score.weight.mul_(3)
        score.bias.add_(0.8)


def save(folder, picture, points, low, scores):
    Image.fromarray(picture).save(folder / "photo.png")
    np.save(folder / "points.npy", points.astype(np.float32))
    np.save(folder / "low.npy", low.numpy())
    np.save(folder / "scores.npy", scores.numpy())


def save_found(folder, picture, generator_with, filters):
    """Saves the masks of an original's mask generator, with `filters`.

    Non-maximum suppression is off: for similar boxes, tiny differences would decide its result.
    """
    generator = generator_with(
        points_per_side=filters["points_per_side"],
        pred_iou_thresh=filters["predicted_iou"],
        stability_score_thresh=filters["stability"],
        crop_n_layers=filters["crop_layers"],
        box_nms_thresh=1.0,
        crop_nms_thresh=1.0,
    )
    found = generator.generate(picture)
    np.save(folder / "masks.npy", np.stack([mask["segmentation"] for mask in found]).astype(np.uint8))
    np.save(folder / "mask_scores.npy", np.array([[mask["predicted_iou"], mask["stability_score"]] for mask in found], np.float32))
    (folder / "filters.json").write_text(json.dumps(filters))
