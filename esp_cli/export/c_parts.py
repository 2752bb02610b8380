"""The functions of an exported C source, one for each kind of layer; names in capitals are replaced by numbers."""

from __future__ import annotations

from collections.abc import Iterable

from esp_cli.export.layers import NORM_EPSILON, Convolution, Floats, GlobalMaxPool, MessageAggregation, Norm

AFFINE = """static void affine(const float *weight, const float *bias, int inputs, int outputs,
                   const float *x, float *y)
{
    int i, j;
    for (j = 0; j < outputs; j++) y[j] = bias[j];
    for (i = 0; i < inputs; i++) {
        for (j = 0; j < outputs; j++) y[j] += x[i] * weight[i * outputs + j];
    }
}
"""

ACTIVATIONS = {
    "relu": """static void apply_relu(float *x, int width)
{
    int k;
    for (k = 0; k < width; k++) x[k] = x[k] > 0.0f ? x[k] : 0.0f;
}
""",
    "tanh": """static void apply_tanh(float *x, int width)
{
    int k;
    for (k = 0; k < width; k++) x[k] = tanhf(x[k]);
}
""",
}

NORM = """static void normalise(const float *weight, const float *bias, int width, float *x)
{
    int k;
    float mean = 0.0f, variance = 0.0f, scale;
    for (k = 0; k < width; k++) mean += x[k];
    mean /= (float)width;
    for (k = 0; k < width; k++) variance += (x[k] - mean) * (x[k] - mean);
    scale = 1.0f / sqrtf(variance / (float)width + NORM_EPSILON);
    for (k = 0; k < width; k++) x[k] = (x[k] - mean) * scale * weight[k] + bias[k];
}
"""

CONVOLVE = """static void convolve(const float *weight, const float *bias, int channels, int rows, int columns,
                     int side, int stride, int outputs, const float *x, float *y)
{
    const int high = (rows - side) / stride + 1, wide = (columns - side) / stride + 1;
    int out, row, column, channel, i, j;
    for (out = 0; out < outputs; out++) {
        for (row = 0; row < high; row++) {
            for (column = 0; column < wide; column++) {
                float sum = bias[out];
                const float *w = weight + out;
                for (channel = 0; channel < channels; channel++) {
                    for (i = 0; i < side; i++) {
                        const float *pixel = x + (channel * rows + row * stride + i) * columns + column * stride;
                        for (j = 0; j < side; j++, w += outputs) sum += pixel[j] * *w;
                    }
                }
                y[(out * high + row) * wide + column] = sum;
            }
        }
    }
}
"""

GLOBAL_MAX_POOL = """static void global_max_pool(int channels, int places, const float *x, float *y)
{
    int channel, place;
    for (channel = 0; channel < channels; channel++) {
        y[channel] = x[channel * places];
        for (place = 1; place < places; place++) {
            if (x[channel * places + place] > y[channel]) y[channel] = x[channel * places + place];
        }
    }
}
"""

AGGREGATE = """static void aggregate(const float *ways, int width, const float *x, float *y)
{
    int i, j, k;
    for (i = 0; i < ESP_POLICY_AGENTS; i++, ways += ESP_POLICY_OBSERVATION) {
        float *own = y + i * ROW, *way = own + width, *received = way + 2, count = 1.0f;
        memcpy(own, x + i * ROW, sizeof(float) * width);
        for (k = 0; k < width + 2; k++) way[k] = 0.0f;
        for (j = 0; j < ESP_POLICY_AGENTS; j++) {
            const float *to = ways + 2 * (j < i ? j : j - 1);
            if (j == i || !(to[0] * to[0] + to[1] * to[1] < REACH_SQUARED)) continue;
            count += 1.0f;
            for (k = 0; k < 2; k++) way[k] += to[k];
            for (k = 0; k < width; k++) received[k] += x[j * ROW + k];
        }
        for (k = 0; k < 2; k++) way[k] /= count * REACH;
        for (k = 0; k < width; k++) received[k] /= count;
    }
}
"""

CHOOSE = """static int choose(const float *x)
{
    int k, best = 0;
    for (k = 1; k < ESP_POLICY_ACTION; k++) {
        if (x[k] > x[best]) best = k;
    }
    return best;
}
"""

CHOOSE_ALLOWED = """static int choose(const float *x, const unsigned char *allowed)
{
    int k, best = -1, any = 0;
    for (k = 0; k < ESP_POLICY_ACTION; k++) any |= allowed[k];
    for (k = 0; k < ESP_POLICY_ACTION; k++) {
        if ((allowed[k] || !any) && (best < 0 || x[k] > x[best])) best = k;
    }
    return best;
}
"""
"""Where nothing is allowed, everything is."""

RECUR = """static float sigmoid(float x)
{
    return 0.5f + 0.5f * tanhf(0.5f * x);
}

static void recur(float *hidden)
{
    int k;
    for (k = 0; k < HIDDEN; k++) {
        const float reset = sigmoid(into[k] + back[k]);
        const float update = sigmoid(into[HIDDEN + k] + back[HIDDEN + k]);
        const float candidate = tanhf(into[2 * HIDDEN + k] + reset * back[2 * HIDDEN + k]);
        hidden[k] = candidate + update * (hidden[k] - candidate);
    }
}
"""


def array(name: str, values: Floats) -> str:
    """Return the definition of a constant array."""
    return f"static const float {name}[{values.size}] = {{\n{numbers(values.ravel().tolist())}}};"


def numbers(values: Iterable[float]) -> str:
    """Return the items of an array, eight a line."""
    literals = [literal(value) for value in values]
    return "".join(f"    {', '.join(literals[k : k + 8])},\n" for k in range(0, len(literals), 8))


def literal(value: float) -> str:
    """Return a float32 in full: nine digits tell every one apart."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def aggregate(layer: MessageAggregation) -> str:
    """Return the function that aggregates messages within the layer's range."""
    return AGGREGATE.replace("REACH_SQUARED", literal(layer.reach_squared)).replace("REACH", literal(layer.reach))


LAYERS = {
    Norm: NORM.replace("NORM_EPSILON", literal(NORM_EPSILON)),
    Convolution: CONVOLVE,
    GlobalMaxPool: GLOBAL_MAX_POOL,
}
"""Functions that the source has where the program has such a layer."""
