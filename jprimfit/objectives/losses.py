"""What training minimises, for the prediction of ONE cloud.

The terms are SPFN's (Li et al. 2019), which the Entropy paper takes over, and those of the head "prototype". Each is
a mean over points or over true instances (an instance without any point here counts, too). Sums and means leave
padding out. A term of weight 0 is not traced. n points, i true instances, s slots.

The terms parameter and residue fit all four kinds to all i columns, which costs far more than the rest: about 100
passes over arrays (i, n, 3) and ten of them in memory. LossConfig.fit_points lets fewer points take part.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST
from jprimfit.objectives import fits, matching, memberships, prototypes
from jprimfit.primitives.table import TYPE_ID
from jprimfit.types import Prediction, Truth


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the terms, 0 = left out; prototype, spread and similarity are terms of the head "prototype" only.

    ValueError if a weight is negative or the sharpness is not positive.
    """

    miou: float = 1.0
    normal: float = 1.0
    type: float = 1.0
    parameter: float = 1.0
    residue: float = 1.0
    orthogonality: float = 0.0
    prototype: float = 1.0
    spread: float = 0.1
    similarity: float = 0.0
    total: float = 1.0  # multiplies the weighted sum
    sharpness: float = 2.0  # of the prototypes' softmax, per squared unit of the embedding
    type_balance: float = 0.0  # share of the mean over instances in the term type, the rest is the mean over points
    fit_points: int = 0  # points that parameter and residue fit to, every n / fit_points-th row; 0 = all

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if value < 0 or (name == "sharpness" and value == 0):
                raise ValueError(f"{name} of the losses is {value}: give a positive number, or 0 to leave a term out")
        if self.type_balance > 1:
            raise ValueError(f"type_balance of the losses is {self.type_balance}: give a share from 0 to 1")


def losses(
    prediction: Prediction, truth: Truth, points: Float[Array, "n 3"], config: LossConfig
) -> dict[str, Float[Array, ""]]:
    """The terms whose weight is not 0, by the names of LossConfig, and "total", their weighted sum.

    points are those that the network saw at the rows of prediction and truth; they carry the dtype of all terms.
    Columns of the head "slots" are matched to the true instances; those of "prototype" belong to them from the start.
    """
    prediction = jax.tree.map(lambda x: x.astype(points.dtype), prediction)
    terms = {}
    if config.normal:
        terms["normal"] = normal_loss(prediction.normals, truth)
    if config.type:
        terms["type"] = type_loss(prediction, truth, balance=config.type_balance)
    terms |= _membership_terms(prediction, truth, points, config)
    total = sum((getattr(config, name) * term for name, term in terms.items()), jnp.zeros((), points.dtype))
    return {**terms, "total": config.total * total}


def _membership_terms(prediction, truth, points, config) -> dict[str, Float[Array, ""]]:
    """The terms that look at memberships, and the fits that hang on them."""
    own = memberships.of_truth(truth, dtype=points.dtype)
    terms = {}
    if prediction.embedding is not None:
        found = prototypes.prototypes(prediction.embedding, own, sharpness=config.sharpness)
        if config.prototype:
            terms["prototype"] = prototypes.cross_entropy(found, own)
        if config.spread:
            terms["spread"] = prototypes.spread(found, own)
        if config.similarity:
            terms["similarity"] = prototypes.similarity(prediction.embedding, own, sharpness=config.sharpness)
        membership = columns = prototypes.membership_of(found, own)
    elif prediction.membership_logits is not None:
        membership = memberships.of_logits(prediction.membership_logits, truth.mask)
        columns = None
    else:
        raise ValueError("the prediction has neither membership_logits nor an embedding: a head must give one of them")
    if config.orthogonality:
        terms["orthogonality"] = orthogonality_loss(membership)
    if not (config.miou or config.parameter or config.residue):
        return terms
    if columns is None:
        iou = jax.lax.stop_gradient(matching.relaxed_iou(own, membership))
        matched = matching.match(iou, truth.instance_mask, jnp.ones(iou.shape[1], bool))
        columns = matching.take_columns(membership, matched)
    if config.miou:
        terms["miou"] = miou_loss(columns, own, truth.instance_mask)
    if config.parameter or config.residue:
        terms |= _fit_terms(columns, prediction.normals, truth, points, config)
    return terms


def miou_loss(
    columns: Float[Array, "n i"], own: Float[Array, "n i"], instance_mask: Bool[Array, " i"]
) -> Float[Array, ""]:
    """Mean over the instances of 1 - relaxed IoU of the matched column; an instance without match counts 1."""
    return _mean(1 - matching.own_iou(own, columns), instance_mask)


def normal_loss(normals: Float[Array, "n 3"], truth: Truth) -> Float[Array, ""]:
    """Mean over the points, background included, of 1 - |cosine| between the predicted and the true normal."""
    return _mean(1 - jnp.abs(jnp.sum(normals * truth.normals, axis=1)), truth.mask)


def type_loss(prediction: Prediction, truth: Truth, *, balance: float = 0.0) -> Float[Array, ""]:
    """Cross-entropy of the type in nats.

    Mean over the points that have an instance, of which a share `balance` may be the mean over instances of their
    means instead: the metric counts instances, and a kind of small ones would drown among the points of others. Or,
    where the network answers for whole segments (segment_type_logits, row k asked for true instance k), mean over the
    instances that have a point. 0 where there is none.
    """
    has_instance = truth.mask & (truth.labels >= 0)
    if prediction.segment_type_logits is None:
        kind = truth.kind[jnp.maximum(truth.labels, 0)]
        surprise = _cross_entropy(prediction.type_logits, kind)
        if not balance:
            return _mean(surprise, has_instance)
        own = memberships.of_truth(truth, dtype=surprise.dtype)
        count = jnp.sum(own, axis=0)
        of_instance = safe.divide(jnp.sum(own * surprise[:, None], axis=0), count)
        return (1 - balance) * _mean(surprise, has_instance) + balance * _mean(of_instance, count > 0)
    num_instances = truth.instance_mask.shape[0]
    present = jnp.zeros(num_instances, bool).at[jnp.maximum(truth.labels, 0)].max(has_instance)
    logits = prediction.segment_type_logits
    if logits.shape[0] != num_instances:
        raise ValueError(
            f"segment_type_logits has {logits.shape[0]} rows for {num_instances} true instances: "
            "ask the network for the true segments while training"
        )
    return _mean(_cross_entropy(logits, truth.kind), present & truth.instance_mask)


def orthogonality_loss(membership: Float[Array, "n s"]) -> Float[Array, ""]:
    """Mean over pairs of different columns of the squared cosine between them; 0 = no point shared by two segments.

    The paper names an orthogonality loss and does not define it; in SPFN, whence its weight 0.1 comes, no code reads
    that key. This is our reading: the mean squared off-diagonal element of V^T V, V = the membership with its columns
    divided by their lengths (empty columns stay 0). It makes no claim to be the authors'.
    """
    num_columns = membership.shape[1]
    directions = safe.unit(membership, axis=0)
    gram = jnp.matmul(directions.T, directions, precision=HIGHEST)
    others = jnp.where(jnp.eye(num_columns, dtype=bool), 0, gram)
    return jnp.sum(others * others) / max(num_columns * (num_columns - 1), 1)


def _fit_terms(columns, normals, truth, points, config) -> dict[str, Float[Array, ""]]:
    """Parameter and residue: of the primitive of the TRUE kind, fitted with the matched soft column."""
    num_points = points.shape[0]
    if 0 < config.fit_points < num_points:
        rows = np.arange(config.fit_points) * num_points // config.fit_points
        points, columns, normals = points[rows], columns[rows], normals[rows]
    surfaces, ok = fits.fit_columns(points, columns, normals)
    ok = fits.of_kind(list(ok), truth.kind)
    terms = {}
    if config.parameter:
        terms["parameter"] = parameter_loss(surfaces, ok, truth)
    if config.residue:
        terms["residue"] = residue_loss(surfaces, ok, truth)
    return terms


def parameter_loss(surfaces: fits.Surfaces, ok: Bool[Array, " i"], truth: Truth) -> Float[Array, ""]:
    """Mean over the instances of 1 - |cosine| between fitted and true axis; a sphere counts 0, a failed fit 1."""
    cosine = jnp.abs(jnp.sum(fits.axes(surfaces, truth.kind) * truth.axis, axis=1))
    error = jnp.where(truth.kind == TYPE_ID["sphere"], 0, jnp.where(ok, 1 - cosine, 1))
    return _mean(error, truth.instance_mask)


def residue_loss(surfaces: fits.Surfaces, ok: Bool[Array, " i"], truth: Truth) -> Float[Array, ""]:
    """Mean over the instances of the mean squared distance of their surface samples to the fitted primitive.

    A failed fit counts as though the primitive were the mean of the samples, a constant without gradient.
    """
    if truth.samples.shape[1] == 0:
        raise ValueError("truth.samples holds no points: the residue loss needs them, set its weight to 0 otherwise")
    distance = fits.distances(surfaces, truth.kind, truth.samples)
    centred = truth.samples - jnp.mean(truth.samples, axis=1, keepdims=True)
    worst = jnp.mean(jnp.sum(centred * centred, axis=2), axis=1)
    return _mean(jnp.where(ok, jnp.mean(distance * distance, axis=1), worst), truth.instance_mask)


def _cross_entropy(logits: Float[Array, "r 4"], kind) -> Float[Array, " r"]:
    log_probability = jax.nn.log_softmax(logits, axis=1)
    return -jnp.sum(jnp.where(jax.nn.one_hot(kind, logits.shape[1], dtype=bool), log_probability, 0), axis=1)


def _mean(values: Float[Array, " r"], mask: Bool[Array, " r"]) -> Float[Array, ""]:
    """Mean over the rows of the mask; 0 if there are none."""
    return safe.divide(jnp.sum(jnp.where(mask, values, 0)), jnp.sum(mask).astype(values.dtype))
