// QMIX's mixer and its hypernetwork: mixer.py of the networks. The weights that the hypernetwork gives are used while
// they are in a core's cache, and computed again on the way back.
//
// A row of weights is W_1 [N, M], b_1 [M], w_2 [M] and b_2.

#include "perceptron.h"

namespace {

// What mixer.py fills in.
struct Mixer {
    int64_t agents, width;
    const float *own;  // [S, R, N]
};

inline Vec size(Vec x) { return x < 0.0f ? -x : x; }

inline Vec sign(Vec x) { return x < 0.0f ? Vec{} - 1.0f : x > 0.0f ? Vec{} + 1.0f : Vec{}; }

inline float sum(Vec x) {
    float total = 0.0f;
    for (int lane = 0; lane < LANES; lane++) total += x[lane];
    return total;
}

// Some of the M hidden units of a row.
struct Units {
    const Mixer &mixer;
    const float *own, *weights;
    int64_t begin, count;

    int64_t first(int64_t agent) const { return agent * mixer.width + begin; }
    int64_t bias() const { return first(mixer.agents); }
    int64_t second() const { return first(mixer.agents + 1); }
    Vec at(int64_t place) const { return load(weights + place, count); }
    // What the units give: elu, whose slope is 1 above 0 and what it gives plus 1 below.
    Vec hidden() const {
        Vec x = at(bias());
        for (int64_t n = 0; n < mixer.agents; n++) x += size(at(first(n))) * own[n];
        return x > 0.0f ? x : exp_of(x) - 1.0f;
    }
};

float mixed(const Mixer &mixer, const float *own, const float *weights) {
    Vec parts = {};
    for (int64_t m = 0; m < mixer.width; m += LANES) {
        Units units{mixer, own, weights, m, std::min<int64_t>(LANES, mixer.width - m)};
        parts += units.hidden() * size(units.at(units.second()));
    }
    return sum(parts) + weights[(mixer.agents + 2) * mixer.width];
}

// Put the gradient by the weights of a row in their place, and write that by the agents' values.
void unmix(const Mixer &mixer, const float *own, float *weights, float above, float *by_own) {
    std::fill(by_own, by_own + mixer.agents, 0.0f);
    for (int64_t m = 0; m < mixer.width; m += LANES) {
        Units units{mixer, own, weights, m, std::min<int64_t>(LANES, mixer.width - m)};
        Vec hidden = units.hidden(), second = units.at(units.second());
        Vec inner = size(second) * above * (hidden > 0.0f ? Vec{} + 1.0f : hidden + 1.0f);
        store(sign(second) * above * hidden, weights + units.second(), units.count);
        store(inner, weights + units.bias(), units.count);
        for (int64_t n = 0; n < mixer.agents; n++) {
            Vec first = units.at(units.first(n));
            store(sign(first) * inner * own[n], weights + units.first(n), units.count);
            by_own[n] += sum(size(first) * inner);
        }
    }
    weights[(mixer.agents + 2) * mixer.width] = above;
}

}  // namespace

extern "C" {

// Compute the team's values [S, R].
void mix_forward(const Perceptron *hypernetwork, const Mixer *mixer, float *total) {
    const Layout net(*hypernetwork);
    pass(net, [&](int64_t seed, Span span, Matrix weights) {
        for (int64_t r = 0; r < span.size(); r++) {
            int64_t row = seed * net.rows + span.begin + r;
            total[row] = mixed(*mixer, mixer->own + row * mixer->agents, weights.at + r * weights.row);
        }
    });
}

// Compute the gradients by the hypernetwork's parameters, by what it sees, and by the agents' values [S, R, N], from
// that by the team's.
void mix_backward(const Perceptron *hypernetwork, const Mixer *mixer, const float *by_total, float *by_parameters,
                  const Below *below, float *by_own) {
    const Layout net(*hypernetwork);
    const int64_t last = net.layers - 1, width = padded(net.out(last)), room = net.packed_room();
    Scratch packed = scratch(net.seeds * room);
    auto fill = [&](const Layout &net, int64_t seed, Span span, float *to) {
        const float *weight = packed.get() + (seed + 1) * room - (net.in(last) + 1) * width;
        apply(net, last, span.size(), net.kept(last, seed, span.begin), weight, to);
        for (int64_t r = 0; r < span.size(); r++) {
            int64_t row = seed * net.rows + span.begin + r, first = row * mixer->agents;
            unmix(*mixer, mixer->own + first, to + r * width, by_total[row], by_own + first);
        }
    };
    pull(net, by_parameters, *below, [&](int64_t s) { pack(net, s, packed.get() + s * room); }, fill);
}

}
