"""The methods, each an entry of one table of the same parts; ``qdos_brax.methods.build`` puts the parts together.

An entry holds the numbers that its authors published, by dotted configuration key; they are laid over the task's YAML
and under the preset, the flags and ``--set`` (``qdos_brax.config``). Published numbers equal to the defaults are not
repeated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Method:
    """Hold the parts and the published values of a method.

    Attributes:
        summary: one line for a list of methods.
        low_level: kind of low-level policy: "trajectory" (a VAE of segments), "transition" (a VAE of single
            transitions), "direction" (conditioned on directions in a Hilbert representation), "noise" (chunks of
            actions that a flow makes of noise), "chunk" (none: the policy chooses chunks of actions) or "action" (none:
            it chooses actions itself).
        weighted: whether segments are weighted by their advantage; otherwise all count the same, and no values are
            learned.
        information: whether the mutual-information term is on.
        guide: the policy that acts in the first steps of an episode online, "diffusion", or None.
        actor_critic: what decides and learns online: "sac", "best-of-n" (of a flow's proposals) or "distilled-flow" (a
            one-step policy near a flow's).
        offline: whether the actor-critic is learned from the data, by its own losses, before it goes on online.
        policy: the flat policy that is learned from the data alone, "bc" or "iql", with no online learning; or None.
        settings: published values by dotted key.
        by_family: published values of single task families.
    """

    summary: str
    low_level: str = "trajectory"
    weighted: bool = False
    information: bool = False
    guide: str | None = None
    actor_critic: str = "sac"
    offline: bool = False
    policy: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    by_family: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


_MANIPULATION = ("cube", "kitchen", "scene")

# What the bonus sees, and which skill a segment is said to have played, in the published code of SUPE, ExPLORe and
# their comparisons. In a task's own units a new place is a large error; with qdos's labels SUPE found no goal of
# antmaze-large (docs/results.md).
_SUPES_LABELS = {"labels.inputs": "raw", "labels.latent": "mean"}

# What an offline row earns without its reward: the least there is on the mazes, what a model of the online rewards
# predicts in manipulation (Wilcoxson et al. 2025, appendix and published commands; the ball's tasks as the mazes).
_UNLABELLED = _SUPES_LABELS | {"labels.offline_reward": "min"}
_UNLABELLED_BY_FAMILY = {family: {"labels.offline_reward": "pred"} for family in _MANIPULATION}

# The dimension that HILP was published with on mazes and kitchen.
_DIRECTIONS = {"skills.latent_dim": 32}

# Nothing of the data but the skills.
_ONLINE_ONLY = _SUPES_LABELS | {"high_level.offline_fraction": 0.0, "labels.bonus_rows": "online"}

# One action per decision, one step per segment.
_FLAT = {"skills.horizon": 1}

# Widths of the published offline policies: 2 x 256 on D4RL's tasks (Kostrikov et al. 2022), 3 x 512 on OGBench's
# (Park et al. 2025).
_OFFLINE_WIDTHS = {
    family: {"policy.hidden": [512, 512, 512], "values.hidden": [512, 512, 512]}
    for family in ("antsoccer", "cube", "humanoidmaze", "scene")
}

# Li, Zhou, Levine 2025, "Reinforcement learning with action chunking" (arXiv 2507.07969, table of hyperparameters and
# code ColinQiyangLi/qc): chunks of 5 actions, 4 layers of 512, 2 critics, discount 0.99, data and experience in one
# buffer, a step of everything per environment step (5 per chunk), none in the first 5,000, in which the offline policy
# acts.
_CONTINUED = {
    "high_level.hidden": [512, 512, 512, 512],
    "high_level.ensemble": 2,
    "high_level.discount": 0.99,
    "high_level.offline_fraction": "auto",
    "labels.rnd_coefficient": 0.0,
}
_CHUNKS = _CONTINUED | {"skills.horizon": 5, "high_level.utd": 5, "high_level.actor_updates": 5}

# Park, Li, Levine 2025, "Flow Q-learning" (arXiv 2502.02538, table and the commands of seohongpark/fql): alpha by task,
# that of going on online where it is another (ball 30 for 10, humanoid 100 for 30), the minimum of the critics on ant
# mazes, discount 0.995 where it is said.
_FQL: dict[str, dict[str, Any]] = {
    "antmaze": {"flow.distillation": 10.0, "flow.target": "min"},
    "antsoccer": {"flow.distillation": 30.0, "high_level.discount": 0.995},
    "humanoidmaze": {"flow.distillation": 100.0, "high_level.discount": 0.995},
    "cube": {"flow.distillation": 300.0},
    "scene": {"flow.distillation": 300.0},
}

METHODS = {
    "qdos": Method("advantage-weighted, diverse skills; rewards of the data", weighted=True, information=True),
    # Wilcoxson et al. 2025, "Leveraging Skills from Unlabeled Prior Data for Efficient Online Exploration". Their code
    # has skills.horizon=4, the comparison in the QDOS paper 20.
    "supe": Method(
        "unweighted skills; the data without its rewards, plus a novelty bonus (Wilcoxson et al. 2025)",
        settings=_UNLABELLED,
        by_family=_UNLABELLED_BY_FAMILY,
    ),
    # Ajay et al. 2021 (OPAL), Pertsch et al. 2020 (SPiRL: with high_level.regulariser=prior); online as in
    # Wilcoxson et al. 2025, "online w/ trajectory skills".
    "trajectory-skills": Method(
        "SUPE's skills; the high level learns without the data (OPAL, Ajay et al. 2021; SPiRL, Pertsch et al. 2020)",
        settings=_ONLINE_ONLY,
        # SPiRL's target divergence: 1 in the maze, 5 in the kitchen (appendix).
        by_family={family: {"high_level.target_divergence": 5.0} for family in _MANIPULATION},
    ),
    # Li et al. 2023, "Accelerating exploration with unlabeled prior data"; the coefficient as SUPE's authors run it.
    "explore": Method(
        "no skills; the data without its rewards, plus a novelty bonus (ExPLORe, Li et al. 2023)",
        low_level="action",
        settings=_FLAT | _UNLABELLED | {"labels.rnd_coefficient": 2.0},
        by_family=_UNLABELLED_BY_FAMILY,
    ),
    # Ball et al. 2023, "Efficient online reinforcement learning with offline data".
    "rlpd": Method(
        "no skills; SAC with an ensemble, half of each batch from the data (RLPD, Ball et al. 2023)",
        low_level="action",
        settings=_FLAT | {"labels.rnd_coefficient": 0.0},
    ),
    # Park et al. 2024, "Foundation policies with Hilbert representations"; online as in Wilcoxson et al. 2025.
    "hilp": Method(
        "directions in a Hilbert representation as skills; online as SUPE (HILP, Park et al. 2024)",
        low_level="direction",
        settings=_UNLABELLED | _DIRECTIONS,
        by_family=_UNLABELLED_BY_FAMILY,
    ),
    "hilp-online": Method(
        "HILP's skills; the high level learns without the data",
        low_level="direction",
        settings=_ONLINE_ONLY | _DIRECTIONS,
    ),
    # Uchendu et al. 2022, "Jump-start reinforcement learning", with the diffusion policy, the schedule and the numbers
    # of Wilcoxson et al. 2025 (published commands): online ExPLORe without the data.
    "diffusion-jsrl": Method(
        "no skills; a diffusion clone of the data acts for an episode's first steps (JSRL, Uchendu et al. 2022)",
        low_level="action",
        guide="diffusion",
        settings=_FLAT | _ONLINE_ONLY | {"labels.rnd_coefficient": 2.0, "high_level.init_temperature": 1.0},
        by_family={family: {"guide.ratio": 0.75} for family in _MANIPULATION},
    ),
    # Kostrikov et al. 2022, "Offline reinforcement learning with implicit Q-learning": expectile 0.9 and beta 10 in
    # mazes, 0.7 and 0.5 in the kitchen; Park et al. 2025 (OGBench): 0.9 and 10.
    "iql": Method(
        "no skills, learned offline only: implicit Q-learning (Kostrikov et al. 2022)",
        low_level="action",
        policy="iql",
        settings=_FLAT | {"values.estimator": "iql", "values.expectile": 0.9, "policy.inverse_temperature": 10.0},
        by_family=_OFFLINE_WIDTHS | {"kitchen": {"values.expectile": 0.7, "policy.inverse_temperature": 0.5}},
    ),
    "bc": Method(
        "no skills, learned offline only: behaviour cloning",
        low_level="action",
        policy="bc",
        settings=_FLAT,
        by_family=_OFFLINE_WIDTHS,
    ),
    # The publication has no ant mazes, no soccer and no humanoids: its values, with FQL's discounts and targets.
    "qc": Method(
        "chunks of actions: the best of N that a flow clone of the data proposes (Q-chunking, Li et al. 2025)",
        low_level="chunk",
        actor_critic="best-of-n",
        offline=True,
        settings=_CHUNKS,
        by_family={
            family: {key: value for key, value in values.items() if key != "flow.distillation"}
            for family, values in _FQL.items()
        },
    ),
    # alpha 100 is the publication's on cube-triple.
    "qc-fql": Method(
        "chunks of actions by flow Q-learning (QC-FQL, Li et al. 2025)",
        low_level="chunk",
        actor_critic="distilled-flow",
        offline=True,
        settings=_CHUNKS | {"flow.distillation": 100.0},
        by_family=_FQL | {"cube": {"flow.distillation": 100.0}, "scene": {"flow.distillation": 100.0}},
    ),
    "fql": Method(
        "a one-step policy near a flow clone of the data, offline and on online (FQL, Park et al. 2025)",
        low_level="action",
        actor_critic="distilled-flow",
        offline=True,
        settings=_FLAT | _CONTINUED | {"high_level.utd": 1},
        by_family=_FQL,
    ),
    # Zhou, Peng, Li, Levine, Kumar 2025, "Efficient online reinforcement learning fine-tuning need not retain offline
    # data" (arXiv 2412.07762; code zhouzypaul/wsrl, its configurations and launch scripts): warm-up of 5,000 steps, 10
    # critics, 2 drawn, 4 critic steps of 256 rows per step, no entropy in the backup. The first temperature is 1 there
    # for rewards of -5 and 5 on ant mazes, 0.1 of ours. Their actor is half as deep on ant mazes, and learns at 1e-4.
    # Their Cal-QL's conservative weight is a multiplier on ant mazes and without importance weights in kitchens; here
    # it is that of their OGBench everywhere. IQL in its place (high_level.initial) has the values of their IQL.
    "wsrl": Method(
        "no skills; actor and critics of an offline phase go on online without the data (WSRL, Zhou et al. 2025)",
        low_level="action",
        settings=_FLAT
        | _ONLINE_ONLY
        | {
            "high_level.initial": "cal-ql",
            "high_level.target_subset": 2,
            "high_level.utd": 4,
            "high_level.init_temperature": 0.1,
            "high_level.target_entropy_scale": 1.0,
            "labels.rnd_coefficient": 0.0,
        },
        by_family={
            "antmaze": {"high_level.hidden": [256, 256, 256, 256]},
            "kitchen": {
                "high_level.hidden": [512, 512, 512],
                "high_level.init_temperature": 1.0,
                "values.expectile": 0.7,
                "policy.inverse_temperature": 0.5,
                "flow.updates": 250_000,
            },
        },
    ),
    # Wagenmaker et al. 2025, "Steering your diffusion policy with latent space reinforcement learning" (arXiv
    # 2506.15799; code ajwagen/dsrl, its configurations of robomimic and gym): SAC on noise that a box bounds, without
    # the data (their DSRL-SAC; DSRL-NA has a second critic, on actions). Chunks of 4 actions (transport: 8); 3 layers
    # of 2,048 (hopper and transport: 128, halfcheetah: 1,024); 20 steps of everything per chunk (lift: 30); the box 1.5
    # (walker: 2.5, transport: 1); the target entropy 0, the temperature 1 at first, as stable-baselines3 begins.
    "dsrl": Method(
        "SAC over the noise of a frozen flow clone of the data (DSRL, Wagenmaker et al. 2025)",
        low_level="noise",
        settings={
            "skills.horizon": 4,
            "skills.latent_box": 1.5,
            "high_level.hidden": [2048, 2048, 2048],
            "high_level.ensemble": 2,
            "high_level.target_subset": 2,
            "high_level.actor_updates": 20,
            "high_level.init_temperature": 1.0,
            "high_level.target_entropy_scale": 0.0,
            "high_level.offline_fraction": 0.0,
            "labels.rnd_coefficient": 0.0,
        },
    ),
    # Osa and Harada 2024, "Discovering multiple solutions from a single task in offline reinforcement learning": z of
    # dimension 2 from [-2, 2], which the high level draws on as the paper does on its own skills.
    "diveoff": Method(
        "latents of single transitions, good and diverse, as skills (DiveOff, Osa and Harada 2024)",
        low_level="transition",
        # The published 10^6 updates are those of the critics, which make two per update here.
        settings={
            "skills.latent_dim": 2,
            "skills.latent_box": 2.0,
            "high_level.latent_map": "box",
            "diveoff.updates": 500_000,
        },
    ),
}


def settings(method: str, family: str) -> dict[str, Any]:
    """Return a method's published values for a task family, by dotted key."""
    entry = METHODS[method]
    return {**entry.settings, **entry.by_family.get(family, {})}
