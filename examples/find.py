#!/usr/bin/env python3
"""Queries a trained scene from Python through the binary. Needs only Python's standard library.

    examples/find.py SCENE cat coffee bicycle

One process answers all texts, so the encoder is loaded only once. Each answer is a line of JSON
with the fields of `fastlgs query --json`. Set FASTLGS if the binary is not on the PATH.
"""

import json
import os
import subprocess
import sys


class Scene:
    """A running `fastlgs query` process, which answers texts until it is closed."""

    def __init__(self, path, *options):
        program = os.environ.get("FASTLGS", "fastlgs")
        command = [program, "query", path, "-", *options]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, text):
        """Returns the answer to a text as a dict. `found` is true if an object matches."""
        self.process.stdin.write(text.replace("\n", " ") + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"fastlgs ended with code {self.process.wait()}; see its message above")
        answer = json.loads(line)
        if "error" in answer:
            raise ValueError(answer["error"])
        return answer

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.stdin.close()
        self.process.wait()


def main():
    if len(sys.argv) < 3:
        sys.exit("usage: find.py SCENE TEXT...")
    with Scene(sys.argv[1]) as scene:
        for text in sys.argv[2:]:
            answer = scene.ask(text)
            if not answer["found"]:
                print(f"{text}: not found (best score {answer['score']:.2f})")
                continue
            for thing in answer["objects"]:
                low, high = thing["bbox3d"]
                size = " x ".join(f"{b - a:.2f}" for a, b in zip(low, high))
                print(f"{text}: object {thing['id']}, score {thing['score']:.2f}, {thing['pixels']} pixels in {answer['view']}, size {size}")


if __name__ == "__main__":
    main()
