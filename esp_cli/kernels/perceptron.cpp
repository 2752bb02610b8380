// The passes of perceptron.py for S seeds at once, in blocks of rows that stay in a core's cache through all layers.
//
// Parameters are [S, in, out] and [S, 1, out], data [S, R, in], row after row; what hidden layers give is kept as
// [S, R, padded(out)], layer after layer. A seed's gradient is summed over parts of its rows that depend on R alone, so
// the results depend neither on the other seeds nor on the number of threads.

#include "vectors.h"

constexpr int64_t BLOCK = 128, PART = 256;

namespace {

// ---- Activations

void activate(float *x, int64_t count, bool tanh) {
    for (int64_t i = 0; i < count; i += LANES) {
        Vec v = vec(x + i);
        vec(x + i) = tanh ? tanh_of(v) : v < 0.0f ? Vec{} : v;
    }
}

// Multiply a gradient by the slope of the activation, read off its output y.
void times_slope(float *gradient, const float *y, int64_t count, bool tanh) {
    for (int64_t i = 0; i < count; i += LANES) {
        Vec g = vec(gradient + i), v = vec(y + i);
        vec(gradient + i) = tanh ? g - g * v * v : v <= 0.0f ? Vec{} : g;
    }
}

// ---- Passes

// What perceptron.py fills in.

struct Perceptron {
    int64_t seeds, rows, layers, tanh, activate_output, threads;
    int64_t stride;                  // of the inputs, from seed to seed
    const int64_t *widths;           // layers + 1
    const float *const *parameters;  // W_1, b_1, ... of the first seed
    const int64_t *strides;          // of each parameter, from seed to seed
    const float *inputs;             // [S, R, widths[0]]
    float *hidden;                   // what hidden layers give, and an activated output; null: not kept
};

struct Outputs {
    float *at;
    int64_t seed, row, column;  // steps to the next one
};

struct Layout : Perceptron {
    Shares shares;
    int64_t widest;

    explicit Layout(const Perceptron &given)
        : Perceptron(given), shares(seeds, rows, PART, threads), widest(PAD) {
        for (int64_t k = 0; k <= layers; k++) widest = std::max(widest, padded(widths[k]));
    }
    int64_t in(int64_t k) const { return widths[k]; }
    int64_t out(int64_t k) const { return widths[k + 1]; }
    bool activates(int64_t k) const { return k < layers - 1 || activate_output; }
    const float *weight(int64_t k, int64_t seed) const { return parameters[2 * k] + seed * strides[2 * k]; }
    const float *bias(int64_t k, int64_t seed) const { return parameters[2 * k + 1] + seed * strides[2 * k + 1]; }
    // What layer k gives to a row, activated.
    float *given(int64_t k, int64_t seed, int64_t row) const {
        int64_t below = 0;
        for (int64_t j = 0; j < k; j++) below += padded(out(j));
        return hidden + below * seeds * rows + (seed * rows + row) * padded(out(k));
    }
    // What layer k reads.
    Matrix read(int64_t k, int64_t seed, int64_t row) const {
        if (k == 0) return {inputs + seed * stride + row * in(0), in(0), 1};
        return {given(k - 1, seed, row), padded(in(k)), 1};
    }
    // Whether the gradient of a weight is computed as [out, in], so that thin outputs are not filled up.
    bool turned(int64_t k) const { return k > 0 && out(k) < PAD; }
    int64_t weight_room(int64_t k) const { return turned(k) ? out(k) * padded(in(k)) : in(k) * padded(out(k)); }
};

// Copy a seed's weights and biases, layer after layer, as [in + 1, padded(out)].
void pack(const Layout &net, int64_t seed, float *to) {
    for (int64_t k = 0; k < net.layers; k++) {
        int64_t width = padded(net.out(k));
        for (int64_t i = 0; i <= net.in(k); i++, to += width) {
            const float *from = i < net.in(k) ? net.weight(k, seed) + i * net.out(k) : net.bias(k, seed);
            std::copy(from, from + net.out(k), to);
            std::fill(to + net.out(k), to + width, 0.0f);
        }
    }
}

// Pass a block of rows through all layers, whose parameters are packed.
void pass(const Layout &net, int64_t seed, Span span, const float *weight, const Outputs &outputs, float *own) {
    Matrix from = net.read(0, seed, span.begin);
    for (int64_t k = 0; k < net.layers; k++) {
        int64_t width = padded(net.out(k));
        bool kept = net.hidden && net.activates(k);
        float *to = kept ? net.given(k, seed, span.begin) : own + (k % 2) * BLOCK * net.widest;
        const float *bias = weight + net.in(k) * width;
        product(span.size(), width, net.in(k), from, weight, width, bias, false, to, width);
        if (net.activates(k)) activate(to, span.size() * width, net.tanh);
        from = {to, width, 1};
        weight = bias + width;
    }
    float *to = outputs.at + seed * outputs.seed + span.begin * outputs.row;
    copy(span.size(), net.out(net.layers - 1), from, to, outputs.row, outputs.column);
}

// Copy a seed's weights, layer after layer, as [out, padded(in)].
void turn(const Layout &net, int64_t seed, float *to) {
    for (int64_t k = 0; k < net.layers; k++)
        for (int64_t o = 0; o < net.out(k); o++, to += padded(net.in(k))) {
            for (int64_t i = 0; i < net.in(k); i++) to[i] = net.weight(k, seed)[i * net.out(k) + o];
            std::fill(to + net.in(k), to + padded(net.in(k)), 0.0f);
        }
}

// Set, or add to, the gradients of a layer's weight and bias from what it reads and the gradient by what it gives.
void learn(const Layout &net, int64_t k, Matrix read, const float *here, int64_t rows, bool add, float *sum) {
    int64_t width = padded(net.out(k));
    if (net.turned(k))
        product(net.out(k), read.row, rows, {here, 1, width}, read.at, read.row, nullptr, add, sum, read.row);
    else
        product(net.in(k), width, rows, {read.at, 1, read.row}, here, width, nullptr, add, sum, width);
    float *bias = sum + net.weight_room(k);
    for (int64_t o = 0; o < width; o += LANES) {
        Vec total = add ? vec(bias + o) : Vec{};
        for (int64_t r = 0; r < rows; r++) total += vec(here + r * width + o);
        vec(bias + o) = total;
    }
}

// Pull the gradient by a block of outputs back through all layers; the weights, turned, and the sums end there.
void pull(const Layout &net, int64_t seed, Span span, bool add, const Outputs &by_outputs, const float *weight,
                 float *sum, float *by_inputs, float *own) {
    float *here = own, *next = own + BLOCK * net.widest;
    int64_t last = net.out(net.layers - 1);
    const float *from = by_outputs.at + seed * by_outputs.seed + span.begin * by_outputs.row;
    if (padded(last) > last) std::fill(here, here + span.size() * padded(last), 0.0f);
    copy(span.size(), last, {from, by_outputs.row, by_outputs.column}, here, padded(last), 1);
    for (int64_t k = net.layers - 1; k >= 0; k--) {
        int64_t below = padded(net.in(k)), width = padded(net.out(k));
        if (net.activates(k)) times_slope(here, net.given(k, seed, span.begin), span.size() * width, net.tanh);
        if (sum) {
            sum -= net.weight_room(k) + width;
            learn(net, k, net.read(k, seed, span.begin), here, span.size(), add, sum);
        }
        weight -= net.out(k) * below;
        if (k == 0 && !by_inputs) return;
        product(span.size(), below, net.out(k), {here, width, 1}, weight, below, nullptr, false, next, below);
        std::swap(here, next);
    }
    float *to = by_inputs + (seed * net.rows + span.begin) * net.in(0);
    copy(span.size(), net.in(0), {here, padded(net.in(0)), 1}, to, net.in(0), 1);
}

// Add the sums of a seed's parts to its gradients [P].
void add_up(const Layout &net, const float *from, float *gradients) {
    for (int64_t part = 0; part < net.shares.parts; part++) {
        float *to = gradients;
        for (int64_t k = 0; k < net.layers; k++) {
            int64_t in = net.in(k), out = net.out(k);
            int64_t row = net.turned(k) ? 1 : padded(out), column = net.turned(k) ? padded(in) : 1;
            for (int64_t i = 0; i < in; i++)
                for (int64_t o = 0; o < out; o++, to++) *to = from[i * row + o * column] + (part ? *to : 0.0f);
            from += net.weight_room(k);
            for (int64_t o = 0; o < out; o++, to++) *to = from[o] + (part ? *to : 0.0f);
            from += padded(out);
        }
    }
}

}  // namespace

extern "C" {

// Compute the outputs, and keep what hidden layers give where there is room for it.
void forward(const Perceptron *given, const Outputs *outputs) {
    const Layout net(*given);
    int64_t room = 0;
    for (int64_t k = 0; k < net.layers; k++) room += (net.in(k) + 1) * padded(net.out(k));
    Scratch packed = scratch(net.seeds * room);
    share_out(
        net.shares, 0, 2 * BLOCK * net.widest, [&](int64_t s) { pack(net, s, packed.get() + s * room); },
        [&](int64_t task, float *own) {
            net.shares.blocks(task, BLOCK, [&](int64_t seed, Span span, bool) {
                pass(net, seed, span, packed.get() + seed * room, *outputs, own);
            });
        },
        [](int64_t) {});
}

// Compute the gradients by the parameters, [S, P] in their order, and by the inputs, [S, R, in], unless they are null.
void backward(const Perceptron *given, const Outputs *by_outputs, float *by_parameters, float *by_inputs) {
    const Layout net(*given);
    int64_t turned_room = 0, sum_room = 0, count = 0;
    for (int64_t k = 0; k < net.layers; k++) {
        turned_room += net.out(k) * padded(net.in(k));
        sum_room += net.weight_room(k) + padded(net.out(k));
        count += (net.in(k) + 1) * net.out(k);
    }
    int64_t sum_count = by_parameters ? net.shares.tasks * sum_room : 0;
    Scratch turned = scratch(net.seeds * turned_room), sums = scratch(sum_count);
    if (net.rows == 0) std::fill(sums.get(), sums.get() + sum_count, 0.0f);
    share_out(
        net.shares, 0, 2 * BLOCK * net.widest, [&](int64_t s) { turn(net, s, turned.get() + s * turned_room); },
        [&](int64_t task, float *own) {
            net.shares.blocks(task, BLOCK, [&](int64_t seed, Span span, bool add) {
                float *sum = by_parameters ? sums.get() + (task + 1) * sum_room : nullptr;
                const float *weight = turned.get() + (seed + 1) * turned_room;
                pull(net, seed, span, add, *by_outputs, weight, sum, by_inputs, own);
            });
        },
        [&](int64_t s) {
            if (by_parameters) add_up(net, sums.get() + s * net.shares.parts * sum_room, by_parameters + s * count);
        });
}

}
