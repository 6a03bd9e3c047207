"""Exports SigLIP of transformers with random weights, and its embeddings of texts and a picture.

    python siglip.py OUT

Writes to OUT/siglip, in the layout of published exports: config.json, preprocessor_config.json,
tokenizer.json, onnx/vision_model.onnx, onnx/text_model.onnx, photo.png, picture.npy (1, d),
texts.json and texts.npy (n, d).
"""

import json
import pathlib
import sys

import numpy as np
import torch
from PIL import Image
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors, trainers
from transformers import PreTrainedTokenizerFast, SiglipConfig, SiglipImageProcessor, SiglipModel, SiglipTextConfig, SiglipVisionConfig

from shared import detailed, framed

TEXTS = ["fox", "a photo of a red bottle.", "Café & crème, 42 pieces!", "the wooden stand's   left leg", "mirror " * 60]
LENGTH = 64


def tokenizer(path):
    """Returns a tokenizer of lower-case word pieces, like SentencePiece. One token ends and pads texts."""
    words = Tokenizer(models.Unigram())
    words.normalizer = normalizers.Sequence([normalizers.NFKC(), normalizers.Lowercase()])
    words.pre_tokenizer = pre_tokenizers.Metaspace()
    trainer = trainers.UnigramTrainer(vocab_size=90, special_tokens=["<pad>", "</s>", "<unk>"], unk_token="<unk>")
    words.train_from_iterator(TEXTS, trainer)
    words.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", words.token_to_id("</s>"))])
    words.save(str(path))
    return PreTrainedTokenizerFast(tokenizer_file=str(path), pad_token="</s>", eos_token="</s>", unk_token="<unk>")


def main():
    out = pathlib.Path(sys.argv[1]) / "siglip"
    (out / "onnx").mkdir(parents=True, exist_ok=True)
    torch.manual_seed(2)
    words = tokenizer(out / "tokenizer.json")
    size = {"hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = SiglipTextConfig(vocab_size=len(words), max_position_embeddings=LENGTH, **size)
    vision = SiglipVisionConfig(image_size=224, patch_size=16, **size)
    siglip = SiglipModel(SiglipConfig(text_config=text.to_dict(), vision_config=vision.to_dict())).eval()
    siglip.config.save_pretrained(out)
    # Equal to "valid" padding, which the exporter does not support by name.
    siglip.vision_model.embeddings.patch_embedding.padding = (0, 0)

    class Tower(torch.nn.Module):
        def __init__(self, tower):
            super().__init__()
            self.tower = tower

        def forward(self, given):
            made = self.tower(given)
            return made.last_hidden_state, made.pooler_output

    given = words(TEXTS, padding="max_length", truncation=True, max_length=LENGTH, return_tensors="pt")["input_ids"]
    outputs, rows = ["last_hidden_state", "pooler_output"], {0: "rows"}
    axes = {"input_ids": {0: "rows", 1: "length"}, "pixel_values": rows}
    for tower, name, example in [(siglip.vision_model, "pixel_values", torch.zeros(2, 3, 224, 224)), (siglip.text_model, "input_ids", given)]:
        file = out / "onnx" / ("vision_model.onnx" if name == "pixel_values" else "text_model.onnx")
        torch.onnx.export(Tower(tower), example, file, input_names=[name], output_names=outputs, dynamic_axes={name: axes[name]}, opset_version=16)

    picture = detailed()
    Image.fromarray(picture).save(out / "photo.png")
    processor = SiglipImageProcessor(size={"height": 224, "width": 224})
    processor.save_pretrained(out)
    with torch.no_grad():
        seen = processor(framed(picture), return_tensors="pt")["pixel_values"]
        np.save(out / "picture.npy", siglip.get_image_features(seen).numpy())
        np.save(out / "texts.npy", siglip.get_text_features(given).numpy())
    (out / "texts.json").write_text(json.dumps(TEXTS))


if __name__ == "__main__":
    main()
