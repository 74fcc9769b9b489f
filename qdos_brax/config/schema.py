"""The fields of a run's configuration, as frozen dataclasses; the defaults are the paper's values."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from qdos_brax.config.rules import Rule, choice, count, field, flag, number, rate, widths

Scannable = float | tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """The data set that is collected when none is given.

    Attributes:
        transitions: environment steps to collect.
        degraded_share: share of the episodes whose behaviour is made bad (heavy noise, wandering, failed attempts).
        noise: standard deviation of the action noise of the other episodes (actions lie in [-1, 1]).
        num_envs: environments stepped side by side.
        seed: seed of the collection; apart from the learner's, so that every seed learns from the same data.
    """

    transitions: int = count(1_000_000)
    degraded_share: float = number(0.5, high=1.0, scan=False)
    noise: float = number(0.2, scan=False)
    num_envs: int = count(64)
    seed: int = count(0, low=0)


@dataclasses.dataclass(frozen=True)
class ValuesConfig:
    """What a state is worth, and from it the segments' advantages.

    Attributes:
        estimator: "graph" (undiscounted steps to success along shortest paths on a graph of logged states) or "iql"
            (implicit Q-learning, the paper's).
        slowness: (graph) the graph is made of those features whose autocorrelation over a segment is at least this.
        max_nodes: (graph) about how many logged states become nodes.
        neighbours: (graph) jumps from each of them to its nearest, and as many to the nearest of other episodes.
        jump_cost: (graph) cost of a jump, in units of the time in which the data changes as far.
        hidden: widths of the hidden layers of V and Q, and of the advantage of skills.
        learning_rate: Adam's, for these.
        batch_size: (iql) transitions per gradient step.
        expectile: (iql) tau of the expectile regression of V.
        discount: (iql) per environment step.
        target_rate: (iql) Polyak rate of the target critic.
        n_step: (iql) environment steps of the bootstrapped return.
        updates: (iql) gradient steps.
    """

    estimator: str = choice("graph", "graph", "iql")
    slowness: float = number(0.9, high=1.0, scan=False)
    max_nodes: int = count(20_000)
    neighbours: int = count(20)
    jump_cost: float = number(1.0, above=True, scan=False)
    hidden: tuple[int, ...] = widths(256, 256)
    learning_rate: Scannable = rate(3e-4)
    batch_size: int = count(256)
    expectile: Scannable = number(0.9, high=1.0, above=True)
    discount: Scannable = number(0.99, high=1.0)
    target_rate: Scannable = number(0.005, high=1.0, above=True)
    n_step: int = count(10)
    updates: int = count(100_000)


@dataclasses.dataclass(frozen=True)
class SkillsConfig:
    """The advantage-weighted trajectory VAE and the mutual information of its skills.

    Attributes:
        horizon: H, environment steps of a segment and of a macro step; 1 for methods without skills.
        latent_dim: size of the skill z.
        encoder_hidden: width of the bidirectional GRU (the posterior).
        encoder_layers: its layers.
        decoder_hidden: widths of the low-level policy's hidden layers.
        prior_hidden: widths of the state prior's hidden layers.
        batch_size: segments per gradient step.
        learning_rate: Adam's.
        kl_weight: beta, the weight of KL(posterior || prior).
        kl_weighted: whether the advantage weight multiplies the KL too (Algorithm 1) or not (equation 4).
        advantage: estimator of a segment's advantage; "segment" is the H-step return plus V(s_H) minus V(s_0),
            "latent" is Q(s_0, z) - V(s_0), "transition" is the mean of Q(s_t, a_t) - V(s_t) (iql only: on a graph it
            is the same as "segment").
        advantage_scale: what A is before it is divided by lambda: "rank" (normal scores of the advantages, so that
            their distribution does not matter) or "std" (advantages over their standard deviation).
        advantage_temperature: lambda in exp(A / lambda).
        weight_clip: largest weight, after the batch's weights were brought to mean 1.
        alpha: weight of the mutual-information loss.
        mi_rollout: where skills are rolled out for that loss: "physics" (the simulator) or "logged" (the policy
            along the data's states).
        mi_every: gradient steps that one batch of rollouts serves.
        mi_batch: rollouts in such a batch.
        latent_box: half the side of the box that random skills are drawn from.
        updates: gradient steps.
    """

    horizon: int = count(20)
    latent_dim: int = count(8)
    encoder_hidden: int = count(256)
    encoder_layers: int = count(2)
    decoder_hidden: tuple[int, ...] = widths(256, 256)
    prior_hidden: tuple[int, ...] = widths(256, 256)
    batch_size: int = count(256)
    learning_rate: Scannable = rate(3e-4)
    kl_weight: Scannable = number(0.1)
    kl_weighted: bool = flag(True)
    advantage: str = choice("segment", "segment", "latent", "transition")
    advantage_scale: str = choice("rank", "rank", "std")
    advantage_temperature: Scannable = number(1.0, above=True)
    weight_clip: Scannable = number(20.0, low=1.0)
    alpha: Scannable = number(0.2)
    mi_rollout: str = choice("physics", "physics", "logged")
    mi_every: int = count(20)
    mi_batch: int = count(64)
    latent_box: Scannable = number(2.0, above=True)
    updates: int = count(500_000)


@dataclasses.dataclass(frozen=True)
class LabelsConfig:
    """Pseudo-labels of the offline segments, and the bonus for novelty.

    Attributes:
        offline_reward: reward of an offline macro transition: the data's own ("data"), the lowest possible ("min"),
            or the reward model's ("pred").
        rnd_coefficient: weight of the random-network-distillation bonus; 0 leaves it out.
        bonus_rows: which rows earn the bonus, "all" or "online".
        rnd_hidden: widths of the hidden layers of its two networks.
        rnd_features: size of their output.
        rnd_learning_rate: Adam's.
        reward_hidden: widths of the reward model's hidden layers.
        reward_learning_rate: Adam's.
        start_env_steps: environment steps before the bonus and the reward model are trained.
    """

    offline_reward: str = choice("data", "data", "min", "pred")
    rnd_coefficient: Scannable = number(8.0)
    bonus_rows: str = choice("all", "all", "online")
    rnd_hidden: tuple[int, ...] = widths(256, 256, 256)
    rnd_features: int = count(256)
    rnd_learning_rate: Scannable = rate(3e-4)
    reward_hidden: tuple[int, ...] = widths(256, 256, 256)
    reward_learning_rate: Scannable = rate(3e-4)
    start_env_steps: int = count(10_000, low=0)


@dataclasses.dataclass(frozen=True)
class HighLevelConfig:
    """The high-level policy: SAC over skills, learned online.

    Attributes:
        hidden: widths of the hidden layers of actor and critics.
        ensemble: critics.
        target_subset: critics drawn for the target's minimum.
        batch_size: macro transitions per gradient step.
        offline_fraction: share of them taken from the labelled data.
        utd: critic steps per macro step of experience.
        learning_rate: Adam's, of actor, critics and temperature.
        discount: per macro step.
        target_rate: Polyak rate of the target critics.
        value_scale: the Q that an output of 1 of a critic's network stands for.
        init_temperature: first value of the entropy temperature.
        regulariser: what the temperature weighs: the actor's entropy ("entropy", SAC), or its divergence from the
            skill prior ("prior", in the bootstrap value too; SPiRL, Pertsch et al. 2020).
        target_entropy_scale: ("entropy") the target entropy is minus this times the width of the action.
        target_divergence: ("prior") KL(actor || skill prior) that the temperature aims at, in nats.
        latent_map: from the action u in (-1, 1) to the skill z: "arctanh", "box" (z = latent_box * u), or "prior"
            (z = mean + latent_box * standard deviation * u of the state prior).
        num_envs: environments stepped side by side.
        warmup_env_steps: first environment steps, acted by the state prior instead of the actor.
        env_steps: environment steps of the online phase, over all environments.
        replay_capacity: macro transitions kept, at most; a run allocates no more than it plays.
    """

    hidden: tuple[int, ...] = widths(256, 256, 256)
    ensemble: int = count(10)
    target_subset: int = count(1)
    batch_size: int = count(256, low=2)
    offline_fraction: float = number(0.5, high=1.0, scan=False)
    utd: int = count(20)
    learning_rate: Scannable = rate(3e-4)
    discount: Scannable = number(0.99, high=1.0)
    target_rate: Scannable = number(0.005, high=1.0, above=True)
    value_scale: float = number(1.0, above=True, scan=False)
    init_temperature: Scannable = number(0.05, above=True)
    regulariser: str = choice("entropy", "entropy", "prior")
    target_entropy_scale: Scannable = number(0.5)
    target_divergence: Scannable = number(1.0)
    latent_map: str = choice("arctanh", "arctanh", "box", "prior")
    num_envs: int = count(1)
    warmup_env_steps: int = count(5_000, low=0)
    env_steps: int = count(200_000)
    replay_capacity: int = count(1_000_000)


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """Flat policies that are learned from the data alone (BC, IQL).

    Attributes:
        hidden: widths of the policy's hidden layers.
        batch_size: transitions per gradient step.
        learning_rate: Adam's.
        inverse_temperature: (IQL) beta of the weights exp(beta A).
        updates: gradient steps.
        every_updates: gradient steps between two evaluations.
    """

    hidden: tuple[int, ...] = widths(256, 256)
    batch_size: int = count(256)
    learning_rate: Scannable = rate(3e-4)
    inverse_temperature: Scannable = number(10.0)
    updates: int = count(1_000_000)
    every_updates: int = count(100_000)


@dataclasses.dataclass(frozen=True)
class GuideConfig:
    """The diffusion policy that clones the data's behaviour, and how long it guides an episode.

    Attributes:
        hidden: width of the denoiser's residual blocks.
        steps: denoising steps.
        batch_size: transitions per gradient step.
        learning_rate: Adam's.
        average_rate: rate at which the average of the parameters, which is what acts, follows them.
        updates: gradient steps.
        ratio: share of the episodes that begin with the guide.
        persistence: probability that the guide goes on after a step.
    """

    hidden: int = count(256)
    steps: int = count(5)
    batch_size: int = count(256)
    learning_rate: Scannable = rate(3e-4)
    average_rate: Scannable = number(0.001, high=1.0, above=True)
    updates: int = count(3_000_000)
    ratio: float = number(0.9, high=1.0, scan=False)
    persistence: float = number(0.99, high=0.9999, scan=False)


@dataclasses.dataclass(frozen=True)
class HilbertConfig:
    """The Hilbert representation of states and the policy that follows its directions (HILP, Park et al. 2024).

    Attributes:
        hidden: widths of the hidden layers of all its networks.
        batch_size: transitions per gradient step.
        learning_rate: Adam's, of all networks.
        expectile: of the distance's regression.
        skill_expectile: of the directions' values.
        discount: per environment step.
        target_rate: Polyak rate of the targets.
        inverse_temperature: beta of the directional policy's weights exp(beta A).
        random_goals: share of goals that are any state; the others lie ahead in the same episode.
        updates: gradient steps.
    """

    hidden: tuple[int, ...] = widths(512, 512, 512)
    batch_size: int = count(1024)
    learning_rate: Scannable = rate(3e-4)
    expectile: Scannable = number(0.95, high=1.0, above=True)
    skill_expectile: Scannable = number(0.9, high=1.0, above=True)
    discount: Scannable = number(0.99, above=True, high=0.9999)
    target_rate: Scannable = number(0.005, high=1.0, above=True)
    inverse_temperature: Scannable = number(10.0)
    random_goals: float = number(0.375, high=1.0, scan=False)
    updates: int = count(1_000_000)


@dataclasses.dataclass(frozen=True)
class DiveOffConfig:
    """Quality and diversity on single transitions (DiveOff, Osa and Harada 2024).

    Attributes:
        hidden: widths of the hidden layers of all its networks.
        batch_size: transitions per gradient step.
        learning_rate: Adam's, of actor and critic.
        autoencoder_rate: of the step on autoencoder and information, as a share of it.
        discount: per environment step.
        target_rate: Polyak rate of the targets.
        scale: of the advantage in the weights exp(scale A).
        kl_weight: of the posterior's divergence, against a mean squared error of reconstruction (the authors' code has
            50, with which the posterior collapses here, see ``qdos_brax.offline.diveoff``).
        information: weight of the information term.
        autoencoder_updates: first gradient steps, without weights and without that term.
        updates: gradient steps.
    """

    hidden: tuple[int, ...] = widths(256, 256)
    batch_size: int = count(256)
    learning_rate: Scannable = rate(3e-4)
    autoencoder_rate: Scannable = number(0.3)
    discount: Scannable = number(0.99, high=1.0)
    target_rate: Scannable = number(0.005, high=1.0, above=True)
    scale: Scannable = number(3.0)
    kl_weight: Scannable = number(0.1)
    information: Scannable = number(2.0)
    autoencoder_updates: int = count(10_000, low=0)
    updates: int = count(1_000_000)


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Evaluation on environments of its own.

    Attributes:
        episodes: episodes per evaluation.
        every_env_steps: online environment steps between two evaluations.
    """

    episodes: int = count(20)
    every_env_steps: int = count(10_000)


@dataclasses.dataclass(frozen=True)
class ScanConfig:
    """How the lists among the other values become members; the lists hold all values, drawn ones too.

    Attributes:
        combine: "product" (every value with every other) or "zip" (first with first, second with second, ..).
        samples: settings drawn at random, each trained with every seed; 0 draws none.
        draw_seed: seed of the draw; each key has its own stream, so that one more key leaves the others' values.
    """

    combine: str = choice("product", "product", "zip")
    samples: int = count(0, low=0)
    draw_seed: int = count(0, low=0)


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """What changes where and how often a run writes, never what it computes.

    Attributes:
        checkpoint_seconds: seconds of work between two checkpoints; 0 saves after every chunk.
        root: folder that holds the run folders whose place is not given with ``--out``.
        tensorboard: whether TensorBoard's event files are written into the run folder.
        wandb: whether the same numbers go to Weights & Biases.
    """

    checkpoint_seconds: float = number(30.0, scan=False)
    root: str = field("runs", Rule("text"))
    tensorboard: bool = flag(True)
    wandb: bool = flag(False)


@dataclasses.dataclass(frozen=True)
class Config:
    """One run, whole.

    Attributes:
        env: the task's name, as ``envs.make`` takes it.
        method: the name of a recipe in ``qdos_brax.methods``.
        preset: the sizes that were laid over the task's values: "paper", "cpu" or "smoke".
        seed: seeds; several make a scan.
        physics: engine: "auto" (MuJoCo C), "mjx", "mjx-warp" (CUDA) or "mujoco".
        members_per_program: members that one device trains at once; 0 lets the program choose before it starts, by
            what is faster on a CPU and by what fits an accelerator. It decides the order of sums, hence last digits.
        dataset: a data file, or None to collect the task's default set.
        out: the run folder, or None to name one under ``run.root``.
        data: collection.
        values: values of states.
        skills: trajectory VAE.
        labels: pseudo-labels.
        high_level: online learner.
        policy: flat offline policies.
        guide: guide of the first steps online.
        hilbert: Hilbert representation.
        diveoff: DiveOff.
        eval: evaluation.
        scan: several values at once.
        run: writing.
    """

    env: str = field("antmaze", Rule("text"))
    method: str = field("qdos", Rule("text"))
    preset: str = field("paper", Rule("text"))
    seed: tuple[int, ...] = field((0,), Rule("seeds", low=0, high=2**32 - 1))
    physics: str = choice("auto", "auto", "mjx", "mjx-warp", "mujoco")
    members_per_program: int = count(0, low=0)
    dataset: str | None = field(None, Rule("path"))
    out: str | None = field(None, Rule("path"))
    data: DataConfig = DataConfig()
    values: ValuesConfig = ValuesConfig()
    skills: SkillsConfig = SkillsConfig()
    labels: LabelsConfig = LabelsConfig()
    high_level: HighLevelConfig = HighLevelConfig()
    policy: PolicyConfig = PolicyConfig()
    guide: GuideConfig = GuideConfig()
    hilbert: HilbertConfig = HilbertConfig()
    diveoff: DiveOffConfig = DiveOffConfig()
    eval: EvalConfig = EvalConfig()
    scan: ScanConfig = ScanConfig()
    run: RunConfig = RunConfig()


def leaves(kind: type[Any], prefix: str = "") -> Iterator[tuple[str, dataclasses.Field[Any]]]:
    """(dotted key, field) of every value, in order."""
    for leaf in dataclasses.fields(kind):
        if dataclasses.is_dataclass(leaf.default):
            yield from leaves(type(leaf.default), f"{prefix}{leaf.name}.")
        else:
            yield f"{prefix}{leaf.name}", leaf


def get(config: Config, key: str) -> Any:
    """The value under a dotted key."""
    node: Any = config
    for name in key.split("."):
        node = getattr(node, name)
    return node


def plain(config: Config) -> dict[str, Any]:
    """Nested dicts with lists for tuples: what YAML and JSON can hold."""

    def listed(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: listed(item) for key, item in value.items()}
        return [listed(item) for item in value] if isinstance(value, tuple) else value

    return {key: listed(value) for key, value in dataclasses.asdict(config).items()}
