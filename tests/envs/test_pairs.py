"""Listed pairs give the contacts that MuJoCo's own search finds, in its order."""

from __future__ import annotations

import mujoco
import numpy as np

from envs.physics.mujoco.pairs import list_pairs

# Bodies of several geoms, one with priority, a welded one, parent and child, bits that let few touch.
CROWD = """
<mujoco><default><geom margin=".02" friction=".7 .1 .2"/></default><worldbody>
<geom name="floor" type="plane" size="9 9 1"/><geom type="box" size=".5 .5 .5" pos="1 0 .3"/>
<body pos="0 0 .3"><freejoint/><geom size=".3" solref=".04 1"/>
  <geom type="capsule" size=".1 .4" pos=".2 0 0" gap=".01"/>
  <body pos=".3 0 0"><geom size=".2" condim="1"/>
    <body pos=".2 .1 0"><joint axis="0 1 0"/><geom type="capsule" size=".1 .3"/><geom size=".2" pos="0 .2 0"/></body>
  </body>
</body>
<body pos=".2 .2 .5"><freejoint/>
  <geom size=".3" priority="1" condim="6" friction=".3 .02 .03" solimp=".8 .9 .01"/></body>
<body pos="-.2 .1 .4"><freejoint/><geom type="capsule" size=".2 .3" contype="2" conaffinity="1"/></body>
</worldbody></mujoco>"""


def test_contacts_are_those_of_the_search_bit_for_bit() -> None:
    spec = mujoco.MjSpec.from_string(CROWD)
    list_pairs(spec)
    models = mujoco.MjModel.from_xml_string(CROWD), spec.compile()
    search, listed = (mujoco.MjData(model) for model in models)
    fields = ("geom", "dim", "dist", "pos", "frame", "friction", "solref", "solimp", "includemargin", "efc_address")
    rng = np.random.default_rng(0)
    most = 0
    for _ in range(200):
        qpos = models[0].qpos0 + rng.uniform(-0.3, 0.3, models[0].nq)
        for model, data in zip(models, (search, listed), strict=True):
            mujoco.mj_resetData(model, data)
            data.qpos[:] = qpos
            mujoco.mj_forward(model, data)
        most = max(most, search.ncon)
        for field in fields:
            np.testing.assert_array_equal(getattr(listed.contact, field), getattr(search.contact, field), err_msg=field)
        np.testing.assert_array_equal(listed.qacc, search.qacc)
    assert most >= 12 and not models[1].geom_contype.any() and models[1].npair > models[1].ngeom
