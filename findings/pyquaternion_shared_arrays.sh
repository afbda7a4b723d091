#!/usr/bin/env bash
# pyquaternion 0.9.9: Quaternion(other), and Quaternion.slerp(q0, q1).
#
# Guess: a copy, and arguments that are left alone but for their length, which the documentation mentions.
# Seen:  the copy shares its numbers with the original: a change of one is a change of both. slerp between
#        quaternions of opposite signs changes the signs of the caller's q0. (quaternion.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyquaternion==0.9.9 numpy==2.4.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

from pyquaternion import Quaternion

original = Quaternion(1, 0, 0, 0)
copy = Quaternion(original)
copy[0] = 5.0
first, second = Quaternion(1, 0, 0, 0), Quaternion(-0.9, 0.1, 0, 0)
Quaternion.slerp(first, second)
print(f"pyquaternion {version('pyquaternion')}: the original after a change of its copy {original.q.tolist()},")
print(f"  q0 = [1, 0, 0, 0] after slerp {first.q.tolist()}")
assert original[0] == 5.0 and first[0] == -1.0, (original, first)
PY
