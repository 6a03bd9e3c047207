"""Exports Segment Anything 2 of its authors with random weights, and its masks.

    python sam_two.py OUT

Writes to OUT/sam2 the same files as sam.py to OUT/authors. The masks are those of ambiguous
prompts (multimask output).
"""

import pathlib
import sys
from functools import partial

import torch
from shared import FILTERS, POINTS, lively, photo, save, save_found

from sam2.automatic_mask_generator import SAM2AutomaticMaskGenerator
from sam2.build_sam import build_sam2
from sam2.sam2_image_predictor import SAM2ImagePredictor

# SAM 2 predicts scores between 0 and 1. With random weights they are near 0.5.
FILTERS = {**FILTERS, "predicted_iou": 0.57, "stability": 0.85}


class Encoder(torch.nn.Module):
    def __init__(self, sam):
        super().__init__()
        self.sam = sam

    def forward(self, image):
        found = self.sam.forward_image(image)
        _, features, _, sizes = self.sam._prepare_backbone_features(found)
        features[-1] = features[-1] + self.sam.no_mem_embed
        return [f.permute(1, 2, 0).reshape(1, -1, *size) for f, size in zip(features, sizes)]


class Decoder(torch.nn.Module):
    """Decoder of points that are already padded, as in exports. The original pads them itself."""

    def __init__(self, sam):
        super().__init__()
        self.prompts, self.head = sam.sam_prompt_encoder, sam.sam_mask_decoder

    def forward(self, image_embed, high_res_feats_0, high_res_feats_1, point_coords, point_labels, mask_input, has_mask_input):
        size = torch.tensor(self.prompts.input_image_size, dtype=torch.float32)
        placed = self.prompts.pe_layer._pe_encoding((point_coords + 0.5) / size)
        labels = point_labels.unsqueeze(-1)
        points = torch.where(labels == -1, self.prompts.not_a_point_embed.weight, placed)
        for label, embedding in enumerate(self.prompts.point_embeddings):
            points = points + embedding.weight * (labels == label)
        none = self.prompts.no_mask_embed.weight.reshape(1, -1, 1, 1)
        given = self.prompts.mask_downscaling(mask_input)
        dense = has_mask_input.reshape(-1, 1, 1, 1) * given + (1 - has_mask_input.reshape(-1, 1, 1, 1)) * none
        masks, scores, _, _ = self.head.predict_masks(
            image_embeddings=image_embed,
            image_pe=self.prompts.get_dense_pe(),
            sparse_prompt_embeddings=points,
            dense_prompt_embeddings=dense.expand(point_coords.shape[0], -1, -1, -1),
            repeat_image=True,
            high_res_features=[high_res_feats_0, high_res_feats_1],
        )
        return masks[:, 1:], scores[:, 1:]


def main():
    folder = pathlib.Path(sys.argv[1]) / "sam2"
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(2)
    torch.manual_seed(1)
    sam = build_sam2("configs/sam2.1/sam2.1_hiera_t.yaml", None, device="cpu", apply_postprocessing=False).eval()
    head = sam.sam_mask_decoder
    lively(
        sam.sam_prompt_encoder.point_embeddings,
        [mlp.layers[-1] for mlp in head.output_hypernetworks_mlps],
        [head.output_upscaling[k] for k in (0, 3)],
        head.iou_prediction_head.layers[-1],
    )
    with torch.no_grad():
        features = Encoder(sam)(torch.zeros(1, 3, 1024, 1024))
    names = ["high_res_feats_0", "high_res_feats_1", "image_embed"]
    torch.onnx.export(Encoder(sam), torch.zeros(1, 3, 1024, 1024), folder / "encoder.onnx", input_names=["image"], output_names=names, opset_version=17)
    given = {
        "image_embed": features[2],
        "high_res_feats_0": features[0],
        "high_res_feats_1": features[1],
        "point_coords": torch.rand(3, 2, 2) * 1024,
        "point_labels": torch.tensor([[1.0, -1.0]] * 3),
        "mask_input": torch.zeros(1, 1, 256, 256),
        "has_mask_input": torch.zeros(1),
    }
    axes = {name: {0: "prompts"} for name in ("point_coords", "point_labels")}
    outputs = ["masks", "iou_predictions"]
    torch.onnx.export(Decoder(sam), tuple(given.values()), folder / "decoder.onnx", input_names=list(given), output_names=outputs, dynamic_axes=axes, opset_version=17)

    picture = photo()
    predictor = SAM2ImagePredictor(sam)
    predictor.set_image(picture)
    asked, labels = torch.tensor(POINTS[:, None]).float(), torch.ones(len(POINTS), 1)
    asked = predictor._transforms.transform_coords(asked, normalize=True, orig_hw=picture.shape[:2])
    with torch.no_grad():
        sparse, dense = sam.sam_prompt_encoder(points=(asked, labels), boxes=None, masks=None)
        finer = [level[-1].unsqueeze(0) for level in predictor._features["high_res_feats"]]
        low, scores, _, _ = head(
            image_embeddings=predictor._features["image_embed"][-1].unsqueeze(0),
            image_pe=sam.sam_prompt_encoder.get_dense_pe(),
            sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense,
            multimask_output=True,
            repeat_image=True,
            high_res_features=finer,
        )
    save(folder, picture, POINTS, low, scores)

    save_found(folder, picture, partial(SAM2AutomaticMaskGenerator, sam), FILTERS)


main()
