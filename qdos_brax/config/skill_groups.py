"""Configuration of what is learned from the data for QDOS: the data set, values of states, and skills."""

from __future__ import annotations

import dataclasses

from qdos_brax.config.rules import choice, count, flag, number, rate, schedule, widths

Scannable = float | tuple[float, ...]
ScannableOrAuto = float | str | tuple[float | str, ...]


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Configure the data set that is collected when none is given."""

    transitions: int = count(1_000_000, "environment steps to collect")
    degraded_share: float = number(
        0.5,
        "share of the episodes with bad behaviour on purpose (heavy noise, wandering, failed attempts)",
        high=1.0,
        scan=False,
    )
    noise: float = number(
        0.2, "standard deviation of the action noise in the other episodes (actions lie in [-1, 1])", scan=False
    )
    num_envs: int = count(64, "environments stepped side by side")
    seed: int = count(
        0, "seed of the collection, apart from the learner's, so that every seed learns from the same data", low=0
    )


@dataclasses.dataclass(frozen=True)
class ObservationConfig:
    """Configure what all that is learned sees of an observation, in the data as in the simulator."""

    view: str = choice(
        "task",
        "task (the observation as the task gives it) or body (beside it, what the task's body sees from where it is, "
        "such as the gaps between a gripper and the cubes)",
        "task",
        "body",
    )


@dataclasses.dataclass(frozen=True)
class ExchangeConfig:
    """Configure counterfactual episodes: things that nobody touched stand as another episode left them."""

    share: float = number(
        0.0,
        "share of the episodes of which that is made (CoDA, Pitis et al. 2020); for tasks whose things are known: "
        "kitchen",
        high=1.0,
        scan=False,
    )
    seed: int = count(0, "seed of the choice, apart from the learner's", low=0)


@dataclasses.dataclass(frozen=True)
class ValuesConfig:
    """Configure the values of states, from which the advantages of segments are computed."""

    estimator: str = choice(
        "graph",
        "graph (undiscounted steps to success along shortest paths on a graph of logged states) or iql (implicit "
        "Q-learning, as in the paper)",
        "graph",
        "iql",
    )
    slowness: float = number(
        0.9,
        "(graph) least autocorrelation over a segment of the features that the graph uses",
        high=1.0,
        scan=False,
    )
    max_nodes: int = count(
        200_000, "(graph) most logged states that become nodes: a tenth of them do, or 20,000 if that is more"
    )
    neighbours: int = count(20, "(graph) jumps from each node to its nearest, and as many to those of other episodes")
    jump_cost: float = number(
        1.0, "(graph) cost of a jump, in units of the time in which the data changes as far", above=True, scan=False
    )
    hidden: tuple[int, ...] = widths((256, 256), "hidden layers of V and Q, and of the advantage of skills")
    learning_rate: Scannable = rate(3e-4, "Adam learning rate of V, Q and the advantage of skills")
    batch_size: int = count(256, "(iql) transitions per gradient step; the method iql has policy.batch_size")
    expectile: Scannable = number(0.9, "(iql) expectile tau of the regression of V", high=1.0, above=True)
    discount: Scannable = number(0.99, "(iql) discount per environment step", high=1.0)
    target_rate: Scannable = number(0.005, "(iql) Polyak rate of the target critic", high=1.0, above=True)
    n_step: int = count(10, "(iql) environment steps of the bootstrapped return; the method iql takes one")
    updates: int = count(100_000, "(iql) gradient steps; the method iql has policy.updates", pretrain=True)


@dataclasses.dataclass(frozen=True)
class SkillsConfig:
    """Configure the advantage-weighted trajectory VAE and the mutual information of its skills."""

    horizon: int = count(20, "environment steps H of a segment and of a macro step; 1 for methods without skills")
    model: str = choice(
        "vae",
        "what a skill is: vae (the latent of a trajectory VAE, as in the paper) or outcome (how far body and things "
        "get in the next outcome_steps; for tasks whose body moves in a plane, with view=body and mi_encoder=outcome)",
        "vae",
        "outcome",
    )
    outcome_steps: int = count(40, "(model outcome) steps ahead of which a skill says what happens")
    latent_dim: int = count(8, "size of the skill z")
    view: str = choice(
        "world",
        "frame in which skills see the body: world (the observation as it is), start (from where it stood and faced "
        "when the skill began) or body (from where it stands and faces now); an arm's: from its finger tips",
        "world",
        "start",
        "body",
    )
    encoder_hidden: int = count(256, "width of the bidirectional GRU (the posterior)")
    encoder_layers: int = count(2, "layers of the bidirectional GRU")
    decoder_hidden: tuple[int, ...] = widths((256, 256), "hidden layers of the low-level policy")
    least_std: float = number(
        0.0,
        "least standard deviation of the low-level policy in the likelihood: actions without noise (at their limit, or "
        "of a part of the data) would count by its inverse square and leave nothing to the others; 0 sets none",
        scan=False,
    )
    prior_hidden: tuple[int, ...] = widths((256, 256), "hidden layers of the state prior")
    batch_size: int = count(256, "segments per gradient step")
    learning_rate: Scannable = rate(3e-4)
    schedule: str = schedule("the last gradient step")
    kl_weight: Scannable = number(0.1, "beta, the weight of KL(posterior || prior)")
    kl_weighted: bool = flag(
        True, "whether the advantage weight multiplies the KL too (Algorithm 1 of the paper) or not (equation 4)"
    )
    advantage: str = choice(
        "segment",
        "estimator of a segment's advantage: segment (H-step return plus V(s_H) minus V(s_0)), latent (Q(s_0, z) - "
        "V(s_0)) or transition (mean of Q(s_t, a_t) - V(s_t); with iql only, on a graph it equals segment)",
        "segment",
        "latent",
        "transition",
    )
    advantage_scale: str = choice(
        "rank",
        "scale of the advantage A before the division by lambda: rank (normal scores, independent of the distribution "
        "of A) or std (A over its standard deviation)",
        "rank",
        "std",
    )
    advantage_temperature: ScannableOrAuto = number(
        1.0, "lambda in the weights exp(A / lambda); auto finds it from effective_share", above=True, auto=True
    )
    effective_share: Scannable = number(
        0.5, "(advantage_temperature auto) effective sample size of the weights over their number", high=1.0, above=True
    )
    weight_clip: Scannable = number(20.0, "largest weight, after the batch's weights are scaled to mean 1", low=1.0)
    alpha: ScannableOrAuto = number(
        0.2,
        "weight of the mutual-information loss; auto adapts it to alpha_error; methods without that loss run with 0",
        label="alpha",
        auto=True,
    )
    alpha_error: Scannable = number(
        0.25,
        "(alpha auto) share of the variance of z that may be lost between a random skill and what it does",
        high=1.0,
    )
    alpha_rate: Scannable = number(0.001, "(alpha auto) ascent of log alpha per gradient step and unit of error")
    mi_rollout: str = choice(
        "physics",
        "where skills are rolled out for the mutual-information loss: physics (the simulator) or logged (the policy "
        "along the data's states)",
        "physics",
        "logged",
    )
    mi_encoder: str = choice(
        "segment",
        "what tells random skills apart: segment (the posterior, by states and actions, as in the paper) or outcome "
        "(an encoder of its own, by how far slow features of the states got while the skill played)",
        "segment",
        "outcome",
    )
    mi_latent: str = choice(
        "box",
        "where random skills are drawn: box (an absolute box, as in the paper) or played (uniformly over what the high "
        "level can play in the state, see high_level.latent_map)",
        "box",
        "played",
    )
    mi_every: int = count(20, "gradient steps that use one batch of rollouts")
    mi_batch: int = count(64, "rollouts per batch")
    latent_box: Scannable = number(2.0, "half the side of the box that random skills are drawn from", above=True)
    updates: int = count(500_000, "gradient steps", pretrain=True)

    @property
    def has_information(self) -> bool:
        """Return whether some member has the mutual-information term: at alpha 0 it has a cost and no gradient."""
        return self.alpha != 0.0
