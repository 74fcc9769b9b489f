"""Configuration of online learning: labels of the offline segments, the high-level policy, and its evaluation."""

from __future__ import annotations

import dataclasses

from qdos_brax.config.rules import choice, count, number, rate, schedule, widths
from qdos_brax.config.skill_groups import Scannable


@dataclasses.dataclass(frozen=True)
class LabelsConfig:
    """Configure the pseudo-labels of the offline segments, and the novelty bonus."""

    offline_reward: str = choice(
        "data",
        "reward of an offline macro transition: data (as recorded), min (the lowest possible) or pred (by the reward "
        "model)",
        "data",
        "min",
        "pred",
    )
    latent: str = choice(
        "sample",
        "skill that a segment is said to have played: a sample of the posterior, or its mean (SUPE's code)",
        "sample",
        "mean",
    )
    inputs: str = choice(
        "normalised",
        "what bonus and reward model see of an observation: normalised, or raw (as the task gives it; SUPE's and "
        "ExPLORe's code)",
        "normalised",
        "raw",
    )
    rnd_coefficient: Scannable = number(8.0, "weight of the random-network-distillation bonus; 0 turns it off")
    bonus_rows: str = choice("all", "rows that get the bonus", "all", "online")
    rnd_hidden: tuple[int, ...] = widths((256, 256, 256), "hidden layers of the bonus's two networks")
    rnd_features: int = count(256, "output size of the bonus's two networks")
    rnd_learning_rate: Scannable = rate(3e-4, "Adam learning rate of the bonus")
    reward_hidden: tuple[int, ...] = widths((256, 256, 256), "hidden layers of the reward model")
    reward_learning_rate: Scannable = rate(3e-4, "Adam learning rate of the reward model")
    start_env_steps: int = count(10_000, "environment steps before bonus and reward model are trained", low=0)


@dataclasses.dataclass(frozen=True)
class HighLevelConfig:
    """Configure the high-level policy: SAC over skills, learned online."""

    hidden: tuple[int, ...] = widths((256, 256, 256), "hidden layers of actor and critics")
    initial: str = choice(
        "random",
        "what actor and critics begin as: random networks, or learned from the labelled data in flow.updates steps, by "
        "implicit Q-learning (iql) or by calibrated conservative Q-learning (cal-ql); they then play first and learn "
        "after high_level.warmup_env_steps, as in WSRL",
        "random",
        "iql",
        "cal-ql",
    )
    ensemble: int = count(10, "number of critics")
    target_subset: int = count(1, "critics drawn for the minimum in the target")
    batch_size: int = count(256, "macro transitions per gradient step", low=2)
    offline_fraction: float | str = number(
        0.5,
        "share of a batch taken from the labelled data; auto draws uniformly from the steps of data and experience, as "
        "of one buffer",
        high=1.0,
        scan=False,
        auto=True,
    )
    utd: int = count(20, "critic steps per macro step of experience")
    actor_updates: int = count(
        1, "steps of actor and temperature per macro step, evenly among the critics' (SUPE: 4 among 80)"
    )
    learning_rate: Scannable = rate(3e-4, "Adam learning rate of actor, critics and temperature")
    schedule: str = schedule("the last environment step")
    discount: Scannable = number(0.99, "discount per macro step", high=1.0)
    target_rate: Scannable = number(0.005, "Polyak rate of the target critics", high=1.0, above=True)
    actor_average: Scannable = number(
        1.0,
        "evaluations and the finished run play a running mean of the actor, which goes this share of the way to it "
        "after each macro step of all environments; 1 is the actor itself",
        high=1.0,
        above=True,
    )
    value_scale: float = number(1.0, "Q per unit of a critic's output", above=True, scan=False)
    init_temperature: Scannable = number(0.05, "first value of the entropy temperature", above=True)
    regulariser: str = choice(
        "entropy",
        "what the temperature weighs: entropy (of the actor, SAC) or prior (the actor's divergence from the skill "
        "prior, in the bootstrap value too; SPiRL, Pertsch et al. 2020)",
        "entropy",
        "prior",
    )
    target_entropy_scale: Scannable = number(
        0.5, "(regulariser entropy) the target entropy is minus this times the width of the action"
    )
    target_divergence: Scannable = number(1.0, "(regulariser prior) target of KL(actor || skill prior), in nats")
    latent_map: str = choice(
        "arctanh",
        "from the action u in (-1, 1) to the skill z: arctanh, box (z = latent_box * u) or prior (z = mean + "
        "latent_box * standard deviation * u of the state prior)",
        "arctanh",
        "box",
        "prior",
    )
    num_envs: int = count(1, "environments stepped side by side")
    warmup_env_steps: int = count(
        5_000,
        "first environment steps, in which the state prior acts instead of the actor; where that was learned offline, "
        "it acts, and does not learn yet",
        low=0,
    )
    env_steps: int = count(200_000, "environment steps of the online phase, over all environments")
    replay_capacity: int = count(1_000_000, "most macro transitions kept; a run allocates no more than it will play")


@dataclasses.dataclass(frozen=True)
class TuningConfig:
    """Configure how skills are fine-tuned online, by a critic of single actions within a skill."""

    skills: str = choice(
        "frozen",
        "frozen (skills stay as they are) or guarded (the low-level policy learns a bounded correction of its actions, "
        "which is played and handed on only while its episodes earn more than those of the frozen skills)",
        "frozen",
        "guarded",
    )
    bound: Scannable = number(0.2, "largest correction of an action's component (actions lie in [-1, 1])", above=True)
    noise: Scannable = number(0.1, "standard deviation of the noise on actions in training, frozen skills' included")
    start_env_steps: int = count(5_000, "environment steps before the correction learns and is tried", low=0)
    trial_share: float = number(
        0.25, "share of the training episodes that play whichever of the two has earned less", high=0.5, scan=False
    )
    window: int = count(40, "recent episodes, about, over which the two are compared", low=4)
    heads: int = count(4, "critics; a correction must be an improvement for each of them")
    batch_size: int = count(32, "macro steps per gradient step, each with all of its environment steps")
    utd: int = count(4, "critic steps per macro step of experience; the correction makes one")
    learning_rate: Scannable = rate(3e-4, "Adam learning rate of critics and correction")
    trace: Scannable = number(
        0.9, "lambda of the returns within a macro step, whose end the high level values", high=1.0
    )
    replay_capacity: int = count(5_000, "most recent macro steps that are learned from")


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Configure the evaluation, which has environments of its own."""

    episodes: int = count(20, "episodes per evaluation")
    every_env_steps: int = count(10_000, "online environment steps between two evaluations")
