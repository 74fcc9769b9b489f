#!/usr/bin/env bash
# MuJoCo 4: an enum is equal to a NumPy integer from one side only, which breaks gymnasium-robotics' kitchen.
#
# Versions: mujoco 4.0.0 against 3.3.7, numpy 2.4.6; gymnasium-robotics 1.4.2. Behaviour: MuJoCo 4's enums answer False to
# `mjtJoint.mjJNT_HINGE == model.jnt_type[0]` (a numpy.int32) and True to the same the other way round; to Python's own
# integers they are equal from both sides. `value in (enum, enum)` puts the enum on the left, so that such a check fails
# without a word about types. MuJoCo 3.3.7 says True to all of them. gymnasium-robotics asks for the type of a joint in
# this way: FrankaKitchen-v1 ends with an AssertionError when it is made. It matters to whoever reads a model's integer
# arrays: write the number from the model on the left of ==, or int(number) in the list.
# Output seen:
#   mujoco 3.3.7: number == enum True, enum == number True, number in enums True, int(number) in enums True
#   mujoco 4.0.0: number == enum True, enum == number False, number in enums False, int(number) in enums True
#   FrankaKitchen-v1 on mujoco 4.0.0: AssertionError
set -euo pipefail
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/compare.py" <<'PY'
import mujoco

xml = "<mujoco><worldbody><body><joint type='hinge'/><geom size='1'/></body></worldbody></mujoco>"
number, enum = mujoco.MjModel.from_xml_string(xml).jnt_type[0], mujoco.mjtJoint.mjJNT_HINGE
found = (number == enum, enum == number, number in (enum,), int(number) in (enum,))
named = zip(("number == enum", "enum == number", "number in enums", "int(number) in enums"), found)
print(f"mujoco {mujoco.__version__}:", ", ".join(f"{name} {bool(equal)}" for name, equal in named), flush=True)
mixed = mujoco.__version__.startswith("4.")
assert found == ((True, False, False, True) if mixed else (True,) * 4), "the release has changed"
PY
python3 -m venv "$work/older"
"$work/older/bin/pip" install --quiet "mujoco==3.3.7" "numpy==2.4.6"
"$work/older/bin/python" "$work/compare.py"
python3 -m venv "$work/newer"
"$work/newer/bin/pip" install --quiet "mujoco==4.0.0" "numpy==2.4.6" "gymnasium-robotics==1.4.2" "gymnasium==1.4.0"
"$work/newer/bin/python" "$work/compare.py"
"$work/newer/bin/python" - <<'PY' 2> "$work/errors" || { cat "$work/errors"; exit 1; }
import gymnasium
import gymnasium_robotics
import mujoco

gymnasium.register_envs(gymnasium_robotics)
try:
    gymnasium.make("FrankaKitchen-v1")
except AssertionError:
    print(f"FrankaKitchen-v1 on mujoco {mujoco.__version__}: AssertionError", flush=True)
else:
    raise SystemExit("FrankaKitchen-v1 is made: the release has changed")
PY
echo "as described"
