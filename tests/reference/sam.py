"""Exports Segment Anything of its authors and of transformers with random weights, and its masks.

    python sam.py OUT

Writes to OUT/authors and OUT/transformers: encoder.onnx, decoder.onnx, photo.png,
points.npy (n, 2; pixels), low.npy (n, masks, 256, 256; logits) and scores.npy (n, masks).
OUT/authors also gets the masks of the authors' mask generator: masks.npy (m, rows, columns),
mask_scores.npy (m, 2; predicted IoU and stability) and filters.json.
"""

import pathlib
import sys
from functools import partial

import torch
from shared import FILTERS, POINTS, lively, photo, save, save_found


def authors(folder, picture, points):
    from segment_anything import SamAutomaticMaskGenerator, SamPredictor
    from segment_anything.modeling import ImageEncoderViT, MaskDecoder, PromptEncoder, Sam, TwoWayTransformer
    from segment_anything.utils.onnx import SamOnnxModel

    norm = partial(torch.nn.LayerNorm, eps=1e-6)
    encoder = ImageEncoderViT(depth=2, embed_dim=64, num_heads=2, mlp_ratio=2, norm_layer=norm, use_rel_pos=True, window_size=14, global_attn_indexes=[1])
    prompts = PromptEncoder(256, (64, 64), (1024, 1024), 16)
    decoder = MaskDecoder(transformer_dim=256, transformer=TwoWayTransformer(2, 256, 8, 512))
    lively(
        prompts.point_embeddings,
        [mlp.layers[-1] for mlp in decoder.output_hypernetworks_mlps],
        [decoder.output_upscaling[k] for k in (0, 3)],
        decoder.iou_prediction_head.layers[-1],
    )
    sam = Sam(encoder, prompts, decoder).eval()

    torch.onnx.export(sam.image_encoder, torch.zeros(1, 3, 1024, 1024), folder / "encoder.onnx", input_names=["image"], output_names=["image_embeddings"], opset_version=16)
    given = {
        "image_embeddings": torch.zeros(1, 256, 64, 64),
        "point_coords": torch.rand(1, 2, 2) * 1024,
        "point_labels": torch.tensor([[1.0, -1.0]]),
        "mask_input": torch.zeros(1, 1, 256, 256),
        "has_mask_input": torch.zeros(1),
        "orig_im_size": torch.tensor([768.0, 1024.0]),
    }
    names = ["masks", "iou_predictions", "low_res_masks"]
    axes = {"point_coords": {1: "points"}, "point_labels": {1: "points"}}
    exported = SamOnnxModel(sam, return_single_mask=False)
    torch.onnx.export(exported, tuple(given.values()), folder / "decoder.onnx", input_names=list(given), output_names=names, dynamic_axes=axes, opset_version=16)

    predictor = SamPredictor(sam)
    predictor.set_image(picture)
    asked = torch.as_tensor(predictor.transform.apply_coords(points[:, None], picture.shape[:2])).float()
    with torch.no_grad():
        sparse, dense = sam.prompt_encoder((asked, torch.ones(len(points), 1)), None, None)
        low, scores = sam.mask_decoder.predict_masks(predictor.features, sam.prompt_encoder.get_dense_pe(), sparse, dense)
    save(folder, picture, points, low, scores)

    save_found(folder, picture, partial(SamAutomaticMaskGenerator, sam), FILTERS)


def transformers(folder, picture, points):
    from transformers import SamConfig, SamImageProcessor, SamModel, SamVisionConfig

    vision = SamVisionConfig(hidden_size=64, num_hidden_layers=2, num_attention_heads=2, mlp_dim=128, global_attn_indexes=[1])
    sam = SamModel(SamConfig(vision_config=vision.to_dict())).eval()
    head = sam.mask_decoder
    lively(
        sam.prompt_encoder.point_embed,
        [mlp.proj_out for mlp in head.output_hypernetworks_mlps],
        [head.upscale_conv1, head.upscale_conv2],
        head.iou_prediction_head.proj_out,
    )

    class Part(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.sam = sam

    class Encoder(Part):
        def forward(self, pixel_values):
            return self.sam.vision_encoder(pixel_values)[0], self.sam.get_image_wide_positional_embeddings().repeat(pixel_values.shape[0], 1, 1, 1)

    class Decoder(Part):
        def forward(self, input_points, input_labels, image_embeddings, image_positional_embeddings):
            sparse, dense = self.sam.prompt_encoder(input_points=input_points, input_labels=input_labels, input_boxes=None, input_masks=None)
            masks, scores, _ = self.sam.mask_decoder(image_embeddings, image_positional_embeddings, sparse, dense, multimask_output=True)
            return scores, masks

    embeddings = ["image_embeddings", "image_positional_embeddings"]
    torch.onnx.export(Encoder(), torch.zeros(1, 3, 1024, 1024), folder / "encoder.onnx", input_names=["pixel_values"], output_names=embeddings, opset_version=16)
    processor = SamImageProcessor()
    ready = processor(picture, return_tensors="pt")
    scale = ready["reshaped_input_sizes"][0, 1].item() / picture.shape[1]
    asked = torch.tensor(points * scale).float()[None, :, None]
    with torch.no_grad():
        features, positions = Encoder()(ready["pixel_values"])
        given = (asked, torch.ones(1, len(points), 1, dtype=torch.int64), features, positions)
        scores, low = Decoder()(*given)
    names = ["input_points", "input_labels", *embeddings]
    # The number of prompts is fixed, because this exporter does not support a dynamic one.
    torch.onnx.export(Decoder(), given, folder / "decoder.onnx", input_names=names, output_names=["iou_scores", "pred_masks"], opset_version=16)
    save(folder, picture, points, low[0], scores[0])


def main():
    out = pathlib.Path(sys.argv[1])
    torch.set_num_threads(2)
    for make in (authors, transformers):
        torch.manual_seed(1)
        folder = out / make.__name__
        folder.mkdir(parents=True, exist_ok=True)
        make(folder, photo(), POINTS)


main()
