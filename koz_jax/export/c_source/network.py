"""A policy's network as C99 source: weights as constants, and the body of ``koz_decide``."""

from collections.abc import Iterable

from koz_jax.agents.numpy_policy import NumpyPolicy
from koz_jax.export.c_source.literals import number, row
from koz_jax.sac.dials import DIAL_FEATURES, spacing
from koz_jax.task.observation_layout import size

_RELU = """static void relu(float *x, int size)
{
    int i;
    for (i = 0; i < size; i++) x[i] = x[i] < 0.0f ? 0.0f : x[i];
}

"""

_DIAL = f"""/* Gaussian features of an entry of the observation, their centres evenly spaced from low on. */
static void dial(float entry, float low, float spacing, float features[{DIAL_FEATURES}])
{{
    int i;
    for (i = 0; i < {DIAL_FEATURES}; i++) {{
        const float steps = (entry - low) / spacing - (float)i;
        features[i] = expf(-0.5f * steps * steps);
    }}
}}

"""

_MODULATE = """/* y = y (1 + features gain), entry by entry */
static void modulate(const float *features, int count, const float *gain, int size, float *y)
{
    int i, j;
    for (j = 0; j < size; j++) {
        float scale = 1.0f;
        for (i = 0; i < count; i++) scale += features[i] * gain[i * size + j];
        y[j] *= scale;
    }
}

"""


def weights(policy: NumpyPolicy) -> str:
    """Kernels, biases and gains of all layers."""
    return "\n\n".join(_weights(policy))


def helpers(policy: NumpyPolicy) -> str:
    """Functions that ``koz_decide`` of this policy calls, besides ``dense``."""
    dials, hidden = bool(policy.dials), len(policy.layers) > 1
    return (_DIAL if dials else "") + (_MODULATE if dials and hidden else "") + (_RELU if hidden else "")


def decide(policy: NumpyPolicy) -> str:
    """Body of ``koz_decide``."""
    return "\n".join(f"    {line}" for line in _decide(policy))


def _weights(policy: NumpyPolicy) -> Iterable[str]:
    for at, layer in enumerate(policy.layers):
        tables = {"kernel": layer.kernel} | ({} if layer.gain is None else {"gain": layer.gain})
        for name, table in tables.items():
            lines = ",\n".join(f"    {row(each)}" for each in table)
            yield f"static const float {name}_{at}[{len(table)} * {table.shape[1]}] = {{\n{lines}\n}};"
        yield f"static const float bias_{at}[{len(layer.bias)}] = {{{row(layer.bias)}}};"


def _decide(policy: NumpyPolicy) -> Iterable[str]:
    """Encode, layer by layer, tanh; features of the dials are the last inputs of every layer."""
    shapes = [layer.kernel.shape for layer in policy.layers]
    features = DIAL_FEATURES * len(policy.dials)
    for at, (inputs, _) in enumerate(shapes):
        yield f"float x{at}[{inputs}];"
    if features:
        yield f"float features[{features}];"
    yield "int i;"
    yield "for (i = 0; i < KOZ_OBSERVATION_SIZE; i++) x0[i] = observation[i];"
    network = policy.record.network
    filled = size(network.observed_zones, network.scaled)
    for start, stop, scale in policy.views:
        seen = f"x0[{filled} + i] = tanhf(observation[{start} + i] / {number(scale)});"
        yield f"for (i = 0; i < {stop - start}; i++) {seen}"
        filled += stop - start
    for at, (entry, low, high) in enumerate(policy.dials):
        numbers = f"{number(low)}, {number(spacing(low, high))}"
        yield f"dial(observation[{entry}], {numbers}, features + {DIAL_FEATURES * at});"
    if features:
        places = " = ".join(f"x{at}[{inputs - features} + i]" for at, (inputs, _) in enumerate(shapes))
        yield f"for (i = 0; i < {features}; i++) {places} = features[i];"
    for at, (inputs, outputs) in enumerate(shapes):
        last = at == len(shapes) - 1
        into = "action" if last else f"x{at + 1}"
        yield f"dense(x{at}, {inputs}, kernel_{at}, bias_{at}, {outputs}, {into});"
        if policy.layers[at].gain is not None:
            yield f"modulate(features, {features}, gain_{at}, {outputs}, {into});"
        if not last:
            yield f"relu({into}, {outputs});"
    yield "for (i = 0; i < KOZ_ACTION_SIZE; i++) action[i] = tanhf(action[i]);"
