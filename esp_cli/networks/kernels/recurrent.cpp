// A gated recurrent unit of S seeds unrolled over T steps: recurrent.py of the networks, a few rows at a time through all
// steps, so that weights and sums stay in a core's cache.
//
// What a step makes of a row lies in four parts, each filled up to padded(H): n, r, z and i = h U_n + b_n. A step's first
// three parts are sums over its input, its last three over the memory before it.

#include "vectors.h"

constexpr int64_t BLOCK = 64;
constexpr int64_t GATE[3] = {1, 2, 0};  // where r, z and n of the parameters stand among n, r, z
constexpr int64_t INNER[3] = {0, 1, 2};  // and among r, z, i

namespace {

// What recurrent.py fills in.
struct Unit {
    int64_t seeds, steps, rows, inputs, hidden, truncation, threads;
    int64_t x_strides[3];         // of seeds, steps and rows
    const float *x;               // [S, T, R, inputs]
    const float *parameters[4];   // W [inputs, 3H], b [3H], U [H, 3H], b' [3H] of the first seed, by r, z, n
    int64_t strides[4];           // from seed to seed
    float *memories;              // [S, T, R, padded(H)] after every step
    float *gates;                 // [S, T, R, 4 padded(H)]; null: not kept
};

struct Layout : Unit {
    int64_t width;
    Shares shares;

    explicit Layout(const Unit &given)
        : Unit(given), width(padded(hidden)), shares(seeds, rows, BLOCK, threads) {}
    Matrix input(int64_t seed, int64_t step, int64_t row) const {
        return {x + seed * x_strides[0] + step * x_strides[1] + row * x_strides[2], x_strides[2], 1};
    }
    // What a step leaves.
    float *memory(int64_t seed, int64_t step, int64_t row) const {
        return memories + ((seed * steps + step) * rows + row) * width;
    }
    float *kept(int64_t seed, int64_t step, int64_t row) const {
        return gates + ((seed * steps + step) * rows + row) * 4 * width;
    }
    // What a step finds; `none` is that before the first.
    const float *before(int64_t seed, int64_t step, int64_t row, const float *none) const {
        return step > 0 ? memory(seed, step - 1, row) : none;
    }
    const float *parameter(int64_t k, int64_t seed) const { return parameters[k] + seed * strides[k]; }
};

// The parameters of a seed as the products want them.
struct Weights {
    float *input, *memory, *bias;  // [inputs, 3 W], [H, 3 W], [4 W]

    static int64_t room(const Layout &unit) { return (unit.inputs + unit.hidden) * 3 * unit.width + 4 * unit.width; }
    Weights(const Layout &unit, float *at)
        : input(at), memory(at + unit.inputs * 3 * unit.width), bias(memory + unit.hidden * 3 * unit.width) {}
};

// Go through the numbers of all parameters [rows, 3 H]: use(k, number of the k-th, row, column among the parts here).
template <class Use>
void each_parameter(const Layout &unit, Use use) {
    const int64_t rows[4] = {unit.inputs, 1, unit.hidden, 1};
    for (int64_t k = 0; k < 4; k++)
        for (int64_t r = 0; r < rows[k]; r++)
            for (int64_t gate = 0; gate < 3; gate++)
                for (int64_t h = 0; h < unit.hidden; h++)
                    use(k, (r * 3 + gate) * unit.hidden + h, r, (k < 2 ? GATE : INNER)[gate] * unit.width + h);
}

void pack(const Layout &unit, int64_t seed, float *at) {
    const Weights to(unit, at);
    float *const parts[4] = {to.input, to.bias, to.memory, to.bias + unit.width};
    std::fill(at, at + Weights::room(unit), 0.0f);
    each_parameter(unit, [&](int64_t k, int64_t i, int64_t r, int64_t column) {
        parts[k][r * 3 * unit.width + column] += unit.parameter(k, seed)[i];
    });
}

inline Vec sigmoid_of(Vec x) { return reciprocal(1.0f + exp_of(-x)); }

// Advance rows by one step, from gates that hold their sums to n, r, z, i.
void advance(int64_t rows, int64_t width, float *gates, const float *before, float *after) {
    for (; rows > 0; rows--, gates += 4 * width, before += width, after += width)
        for (int64_t h = 0; h < width; h += LANES) {
            Vec r = sigmoid_of(vec(gates + width + h)), z = sigmoid_of(vec(gates + 2 * width + h));
            Vec n = tanh_of(vec(gates + h) + r * vec(gates + 3 * width + h));
            vec(gates + h) = n;
            vec(gates + width + h) = r;
            vec(gates + 2 * width + h) = z;
            vec(after + h) = n + z * (vec(before + h) - n);
        }
}

// Turn the gates of a step into the gradients by their sums, from that by the memory it gives, of which the part is left
// that passes the gates by.
void pull(int64_t rows, int64_t width, const float *gates, const float *before, float *carry, float *d) {
    for (; rows > 0; rows--, gates += 4 * width, before += width, carry += width, d += 4 * width)
        for (int64_t h = 0; h < width; h += LANES) {
            Vec n = vec(gates + h), r = vec(gates + width + h), z = vec(gates + 2 * width + h);
            Vec above = vec(carry + h), passed = above * z, by_n = (above - passed) * (1.0f - n * n);
            vec(d + h) = by_n;
            vec(d + width + h) = by_n * vec(gates + 3 * width + h) * (r - r * r);
            vec(d + 2 * width + h) = (vec(before + h) - n) * above * (z - z * z);
            vec(d + 3 * width + h) = by_n * r;
            vec(carry + h) = passed;
        }
}

// Take rows through all steps; `own` has room for the gates of one step, `none` is empty memory.
void forward_block(const Layout &unit, int64_t seed, Span span, const Weights &weights, float *own, const float *none) {
    int64_t width = unit.width, rows = span.size();
    for (int64_t t = 0; t < unit.steps; t++) {
        float *gates = unit.gates ? unit.kept(seed, t, span.begin) : own;
        const float *before = unit.before(seed, t, span.begin, none);
        product(rows, 3 * width, unit.inputs, unit.input(seed, t, span.begin), weights.input, 3 * width, weights.bias,
                false, gates, 4 * width);
        for (int64_t r = 0; r < rows; r++)
            std::copy(weights.bias + 3 * width, weights.bias + 4 * width, gates + (4 * r + 3) * width);
        if (t > 0)
            product(rows, 3 * width, unit.hidden, {before, width, 1}, weights.memory, 3 * width, nullptr, true,
                    gates + width, 4 * width);
        advance(rows, width, gates, before, unit.memory(seed, t, span.begin));
    }
}

// Add the gradients by the parameters, laid out as `Weights`, from those by a step's sums.
void learn(const Layout &unit, const Weights &sum, Matrix x, const float *before, int64_t rows, const float *d) {
    int64_t width = unit.width, row = 4 * width;
    product(unit.inputs, 3 * width, rows, {x.at, x.column, x.row}, d, row, nullptr, true, sum.input, 3 * width);
    product(unit.hidden, 3 * width, rows, {before, 1, width}, d + width, row, nullptr, true, sum.memory, 3 * width);
    for (int64_t k = 0; k < row; k += LANES) {
        Vec total = vec(sum.bias + k);
        for (int64_t r = 0; r < rows; r++) total += vec(d + r * row + k);
        vec(sum.bias + k) = total;
    }
}

// Turn a seed's weights: W' [3 W, padded(inputs)] and, behind it, U' [3 W, W].
void turn(const Layout &unit, int64_t seed, float *input) {
    int64_t width = unit.width, below = padded(unit.inputs);
    float *memory = input + 3 * width * below;
    std::fill(input, memory + 3 * width * width, 0.0f);
    each_parameter(unit, [&](int64_t k, int64_t i, int64_t r, int64_t column) {
        if (k == 0) input[column * below + r] = unit.parameter(k, seed)[i];
        if (k == 2) memory[column * width + r] = unit.parameter(k, seed)[i];
    });
}

// Pull the gradient by all memories of some rows, [S, T, R, H] with its steps, back to the parameters and to the inputs,
// [S, T, R, inputs]; `own` has room for one step, and the weights are turned.
void backward_block(const Layout &unit, int64_t seed, Span span, const float *by_memories, const int64_t *strides,
                    const float *input, const Weights &sum, float *by_inputs, float *own, const float *none) {
    int64_t width = unit.width, rows = span.size(), below = padded(unit.inputs);
    const float *memory = input + 3 * width * below;
    float *carry = own, *d = carry + BLOCK * width, *by_x = d + BLOCK * 4 * width;
    std::fill(carry, carry + rows * width, 0.0f);
    for (int64_t t = unit.steps - 1; t >= 0; t--) {
        const float *above = by_memories + seed * strides[0] + t * strides[1] + span.begin * strides[2];
        for (int64_t r = 0; r < rows; r++)
            for (int64_t h = 0; h < unit.hidden; h++) carry[r * width + h] += above[r * strides[2] + h];
        const float *before = unit.before(seed, t, span.begin, none);
        pull(rows, width, unit.kept(seed, t, span.begin), before, carry, d);
        learn(unit, sum, unit.input(seed, t, span.begin), before, rows, d);
        product(rows, below, 3 * width, {d, 4 * width, 1}, input, below, nullptr, false, by_x, below);
        float *to = by_inputs + ((seed * unit.steps + t) * unit.rows + span.begin) * unit.inputs;
        copy(rows, unit.inputs, {by_x, below, 1}, to, unit.inputs, 1);
        if (unit.truncation && t % unit.truncation == 0)
            std::fill(carry, carry + rows * width, 0.0f);
        else
            product(rows, width, 3 * width, {d + width, 4 * width, 1}, memory, width, nullptr, true, carry, width);
    }
}

// Add the sums of a seed's parts to its gradients, W, b, U and b' in a row.
void add_up(const Layout &unit, float *sums, float *gradients) {
    const int64_t row = 3 * unit.hidden, in = unit.inputs, ends = in + unit.hidden + 2;
    float *const to[4] = {gradients, gradients + in * row, gradients + (in + 1) * row, gradients + (ends - 1) * row};
    std::fill(gradients, gradients + ends * row, 0.0f);
    for (int64_t part = 0; part < unit.shares.parts; part++, sums += Weights::room(unit)) {
        const Weights sum(unit, sums);
        const float *const from[4] = {sum.input, sum.bias, sum.memory, sum.bias + unit.width};
        each_parameter(unit, [&](int64_t k, int64_t i, int64_t r, int64_t column) {
            to[k][i] += from[k][r * 3 * unit.width + column];
        });
    }
}

}  // namespace

extern "C" {

// Compute every memory, and keep the gates where there is room for them.
void gru_forward(const Unit *given) {
    const Layout unit(*given);
    int64_t room = Weights::room(unit), size = BLOCK * unit.width;
    Scratch packed = scratch(unit.seeds * room);
    share_out(
        unit.shares, size, 4 * size, [&](int64_t s) { pack(unit, s, packed.get() + s * room); },
        [&](int64_t task, float *own) {
            unit.shares.blocks(task, BLOCK, [&](int64_t seed, Span span, bool) {
                forward_block(unit, seed, span, Weights(unit, packed.get() + seed * room), own + size, own);
            });
        },
        [](int64_t) {});
}

// Compute the gradients by the parameters, [S, P] in their order, and by the inputs, [S, T, R, inputs], from that by the
// memories.
void gru_backward(const Unit *given, const float *by_memories, const int64_t *strides, float *by_parameters,
                  float *by_inputs) {
    const Layout unit(*given);
    int64_t width = unit.width, room = Weights::room(unit), below = padded(unit.inputs), size = BLOCK * width;
    int64_t turned_room = 3 * width * (below + width), count = 3 * unit.hidden * (unit.inputs + unit.hidden + 2);
    Scratch turned = scratch(unit.seeds * turned_room), sums = scratch(unit.shares.tasks * room);
    share_out(
        unit.shares, size, 5 * size + BLOCK * below,
        [&](int64_t s) { turn(unit, s, turned.get() + s * turned_room); },
        [&](int64_t task, float *own) {
            float *sum = sums.get() + task * room;
            std::fill(sum, sum + room, 0.0f);
            unit.shares.blocks(task, BLOCK, [&](int64_t seed, Span span, bool) {
                const float *input = turned.get() + seed * turned_room;
                backward_block(unit, seed, span, by_memories, strides, input, Weights(unit, sum), by_inputs, own + size,
                               own);
            });
        },
        [&](int64_t s) { add_up(unit, sums.get() + s * unit.shares.parts * room, by_parameters + s * count); });
}

}
