// QMIX's mixer: mixer.py of the networks, one row after the other.
//
// A row of weights is W_1 [N, M], b_1 [M], w_2 [M] and b_2, as the hypernetwork gives them.

#include "vectors.h"

constexpr int64_t ROWS = 128;

namespace {

// What mixer.py fills in.
struct Mixer {
    int64_t seeds, rows, agents, width, threads;
    const float *own;      // [S, R, N]
    const float *weights;  // [S, R, N M + 2 M + 1]
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

template <class Use>
void each_row(const Mixer &mixer, Use use) {  // use(row of all seeds', its values, its weights)
    const Shares shares(mixer.seeds, mixer.rows, ROWS, mixer.threads);
    int64_t each = (mixer.agents + 2) * mixer.width + 1;
#pragma omp parallel for schedule(static) num_threads(shares.busy)
    for (int64_t task = 0; task < shares.tasks; task++)
        for (Span left = shares.of(task); left.size() > 0; left.begin++) {
            int64_t row = task / shares.parts * mixer.rows + left.begin;
            use(row, mixer.own + row * mixer.agents, mixer.weights + row * each, row * each);
        }
}

}  // namespace

extern "C" {

// Compute the team's values [S, R].
void mix_forward(const Mixer *mixer, float *total) {
    each_row(*mixer, [=](int64_t row, const float *own, const float *weights, int64_t) {
        Vec parts = {};
        for (int64_t m = 0; m < mixer->width; m += LANES) {
            Units units{*mixer, own, weights, m, std::min<int64_t>(LANES, mixer->width - m)};
            parts += units.hidden() * size(units.at(units.second()));
        }
        total[row] = sum(parts) + weights[(mixer->agents + 2) * mixer->width];
    });
}

// Compute the gradients by the agents' values and by the weights, of their shapes, from that by the team's values.
void mix_backward(const Mixer *mixer, const float *by_total, float *by_own, float *by_weights) {
    each_row(*mixer, [=](int64_t row, const float *own, const float *weights, int64_t at) {
        float above = by_total[row], *by = by_weights + at, *by_value = by_own + row * mixer->agents;
        std::fill(by_value, by_value + mixer->agents, 0.0f);
        for (int64_t m = 0; m < mixer->width; m += LANES) {
            Units units{*mixer, own, weights, m, std::min<int64_t>(LANES, mixer->width - m)};
            Vec hidden = units.hidden(), second = units.at(units.second());
            Vec inner = size(second) * above * (hidden > 0.0f ? Vec{} + 1.0f : hidden + 1.0f);
            store(sign(second) * above * hidden, by + units.second(), units.count);
            store(inner, by + units.bias(), units.count);
            for (int64_t n = 0; n < mixer->agents; n++) {
                Vec first = units.at(units.first(n));
                store(sign(first) * inner * own[n], by + units.first(n), units.count);
                by_value[n] += sum(size(first) * inner);
            }
        }
        by[(mixer->agents + 2) * mixer->width] = above;
    });
}

}
