#!/usr/bin/env bash
# MuJoCo: a contact's margin is the larger of its geoms' two margins up to 3.4, and their sum from 3.5 on.
#
# Versions: mujoco 3.4.0 and 4.0.0. Behaviour: one model, two geoms with margin="0.01" each. A sphere whose surface is
# 0.012 above a plane makes no contact in 3.4.0 and one in 4.0.0 (includemargin 0.01 against 0.02). No warning is given.
# It matters for this field's data: files recorded with an older MuJoCo and replayed with a newer one rest higher
# (twice the margin of an ant's legs: one centimetre) and part from the log at the first contact.
# Output seen:
#   3.4.0 gap 0.005 contacts 1, gap 0.012 contacts 0, gap 0.018 contacts 0, gap 0.025 contacts 0
#   4.0.0 gap 0.005 contacts 1, gap 0.012 contacts 1, gap 0.018 contacts 1, gap 0.025 contacts 0
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/probe.py" <<'PY'
import mujoco

XML = """<mujoco><worldbody>
  <geom type="plane" size="1 1 .1" margin="0.01"/>
  <body pos="0 0 1"><freejoint/><geom type="sphere" size="0.1" margin="0.01"/></body>
</worldbody></mujoco>"""
model = mujoco.MjModel.from_xml_string(XML)
data = mujoco.MjData(model)
seen = []
for gap in (0.005, 0.012, 0.018, 0.025):
    data.qpos[2] = 0.1 + gap
    mujoco.mj_forward(model, data)
    seen.append(f"gap {gap} contacts {data.ncon}")
print(mujoco.__version__, ", ".join(seen))
PY
for version in 3.4.0 4.0.0; do
    python3 -m venv "$work/$version"
    "$work/$version/bin/pip" install --quiet "mujoco==$version" "numpy==2.4.6"
    "$work/$version/bin/python" "$work/probe.py" | tee -a "$work/seen.txt"
done
diff "$work/seen.txt" - <<'SEEN'
3.4.0 gap 0.005 contacts 1, gap 0.012 contacts 0, gap 0.018 contacts 0, gap 0.025 contacts 0
4.0.0 gap 0.005 contacts 1, gap 0.012 contacts 1, gap 0.018 contacts 1, gap 0.025 contacts 0
SEEN
echo "as described"
