"""Runs the tests, prints their output, and lists the ten slowest and the skipped ones.

Usage: slowest.py COMMAND...
"""

import os
import re
import subprocess
import sys

# Test programs report times only with unstable options, which this variable allows.
# Cargo must not see the variable, because it would rebuild everything.
command = sys.argv[1:]
built = subprocess.run([*command[: command.index("--")], "--no-run"])
if built.returncode != 0:
    sys.exit(built.returncode)
wrapper = os.path.join(os.path.dirname(os.path.abspath(__file__)), "support", "timed.sh")
host = subprocess.run(["rustc", "-vV"], capture_output=True, text=True).stdout
host = re.search(r"host: (\S+)", host).group(1).replace("-", "_").upper()
environment = dict(os.environ, **{f"CARGO_TARGET_{host}_RUNNER": wrapper})
running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
times, skipped = [], set()
for line in running.stdout:
    print(line, end="", flush=True)
    found = re.match(r"test (.+?)(?: - .+)? \.\.\. \w+ <([\d.]+)s>", line)
    if found:
        times.append((float(found.group(2)), found.group(1)))
    if "SKIPPED: " in line:
        skipped.add(line[line.index("SKIPPED: ") + 9 :].strip())
running.wait()
print("slowest tests:")
for seconds, name in sorted(times, reverse=True)[:10]:
    print(f"  {seconds:7.1f} s  {name}")
for reason in sorted(skipped):
    print(f"skipped tests: {reason}")
sys.exit(running.returncode)
