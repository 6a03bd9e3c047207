"""Exports CLIP of transformers with random weights, and its embeddings of texts and a picture.

    python clip.py OUT MERGES

MERGES is OpenAI's published list of merges. Writes to OUT/clip: image.onnx, text.onnx,
preprocessor_config.json, photo.png, picture.npy (1, d), texts.json and texts.npy (n, d).
"""

import gzip
import json
import pathlib
import sys
import tempfile

import numpy as np
import torch
from PIL import Image
from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPTextConfig, CLIPTokenizer, CLIPVisionConfig

from shared import detailed, framed

TEXTS = ["fox", "a photo of a red bottle.", "Café & crème, 42 pieces!", "the wooden stand's   left leg", "mirror"]


def tokenizer(merges):
    """Returns the published tokenizer.

    Its tokens are bytes, bytes that end a word, merged pairs, and two special tokens.
    """
    from transformers.models.clip.tokenization_clip import bytes_to_unicode

    pairs = gzip.open(merges, "rt", encoding="utf-8").read().split("\n")[1 : 49152 - 256 - 2 + 1]
    signs = list(bytes_to_unicode().values())
    words = signs + [s + "</w>" for s in signs] + ["".join(p.split()) for p in pairs] + ["<|startoftext|>", "<|endoftext|>"]
    with tempfile.TemporaryDirectory() as folder:
        vocabulary, rules = pathlib.Path(folder, "vocab.json"), pathlib.Path(folder, "merges.txt")
        vocabulary.write_text(json.dumps({word: k for k, word in enumerate(words)}))
        rules.write_text("#version: 0.2\n" + "\n".join(pairs) + "\n")
        return CLIPTokenizer(str(vocabulary), str(rules))


def main():
    out, merges = pathlib.Path(sys.argv[1]) / "clip", sys.argv[2]
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(1)
    text = CLIPTextConfig(hidden_size=64, intermediate_size=128, num_hidden_layers=2, num_attention_heads=2, eos_token_id=49407)
    vision = CLIPVisionConfig(hidden_size=64, intermediate_size=128, num_hidden_layers=2, num_attention_heads=2, patch_size=16)
    clip = CLIPModel(CLIPConfig(text_config=text.to_dict(), vision_config=vision.to_dict(), projection_dim=32)).eval()
    with torch.no_grad():
        # Larger weights make the embeddings depend on their input.
        for parameter in clip.parameters():
            parameter.mul_(2)

    class Image_(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.clip = clip

        def forward(self, pixel_values):
            return self.clip.get_image_features(pixel_values)

    class Text(Image_):
        def forward(self, input_ids, attention_mask):
            return self.clip.get_text_features(input_ids, attention_mask)

    tokens = tokenizer(merges)(TEXTS, padding="max_length", max_length=77, return_tensors="pt")
    given = (tokens["input_ids"], tokens["attention_mask"])
    rows = {0: "rows"}
    torch.onnx.export(Image_(), torch.zeros(2, 3, 224, 224), out / "image.onnx", input_names=["pixel_values"], output_names=["image_embeds"], dynamic_axes={"pixel_values": rows}, opset_version=16)
    names = ["input_ids", "attention_mask"]
    torch.onnx.export(Text(), given, out / "text.onnx", input_names=names, output_names=["text_embeds"], dynamic_axes={n: rows for n in names}, opset_version=16)

    picture = detailed()
    Image.fromarray(picture).save(out / "photo.png")
    processor = CLIPImageProcessor()
    processor.save_pretrained(out)
    with torch.no_grad():
        np.save(out / "picture.npy", clip.get_image_features(processor(framed(picture), return_tensors="pt")["pixel_values"]).numpy())
        np.save(out / "texts.npy", clip.get_text_features(*given).numpy())
    (out / "texts.json").write_text(json.dumps(TEXTS))


main()
