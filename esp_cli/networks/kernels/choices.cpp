// Choices among A actions by softmax, as many rows at once as a vector holds: choices.py of the networks.
//
// Parts are the originals and copies of them. Data are [S, R] or [S, L, R] of the L parts that are learned from.

#include "vectors.h"

namespace {

// What choices.py fills in.
struct Choices {
    int64_t seeds, parts, rows, actions, threads;
    int64_t by_seed, by_row, by_action;  // steps between the outputs [S, P R, A]
    const int64_t *orders;               // [S, P, A]: which output of a part is the original's action
    const float *outputs;
    float *log_prob, *prob;  // [S, A, P, R]
    float *entropy, *gap;    // [S, P, R]; the gap of a part is KL[part || original]
};

// What losses add to the slope by the outputs. No data: they do not, or the weight is a number.
struct Slope {
    int64_t learned, moves_copies, moves_originals;
    float entropy_weight, gap_weight;
    const int64_t *action;                                        // [S, R]
    const float *by_log_prob, *entropy_weights, *gap_weights;     // [S, L, R], [S, R], [S, R]
};

// Some rows of a seed.
struct Batch {
    const Choices &of;
    int64_t seed, begin, count;  // count <= LANES

    int64_t output(int64_t part, int64_t lane, int64_t a) const {
        return seed * of.by_seed + (part * of.rows + begin + lane) * of.by_row +
               of.orders[(seed * of.parts + part) * of.actions + a] * of.by_action;
    }
    int64_t number(int64_t part, int64_t a) const {
        return ((seed * of.actions + a) * of.parts + part) * of.rows + begin;
    }
    int64_t row(int64_t part, int64_t parts) const { return (seed * parts + part) * of.rows + begin; }
    Vec read(const float *x, int64_t at) const { return load(x + at, count); }
};

template <class Use>
void each_batch(const Choices &of, int64_t vectors, Use use) {
    const Shares shares(of.seeds, of.rows, 256, of.threads);
    auto work = [&](int64_t task, float *own) {
        for (Span left = shares.of(task); left.size() > 0; left.begin += LANES)
            use(Batch{of, task / shares.parts, left.begin, std::min<int64_t>(LANES, left.size())}, &vec(own));
    };
    share_out(shares, 0, vectors * LANES, [](int64_t) {}, work, [](int64_t) {});
}

// Write log_prob, prob, entropy and gap of a part; `first` are the log-probabilities of the originals.
void softmax(const Batch &batch, int64_t part, Vec *first, Vec *log_prob) {
    const Choices &of = batch.of;
    Vec most = {}, sum = {}, entropy = {}, gap = {};
    for (int64_t a = 0; a < of.actions; a++) {
        Vec x = {};
        for (int64_t i = 0; i < batch.count; i++) x[i] = of.outputs[batch.output(part, i, a)];
        most = a == 0 ? x : x > most ? x : most;
        log_prob[a] = x;
    }
    for (int64_t a = 0; a < of.actions; a++) sum += exp_of(log_prob[a] - most);
    Vec log_sum = most + log_of(sum);
    for (int64_t a = 0; a < of.actions; a++) {
        Vec own = log_prob[a] - log_sum, likely = exp_of(own);
        if (part == 0) first[a] = own;
        entropy -= likely * own;
        gap += likely * (own - first[a]);
        store(own, of.log_prob + batch.number(part, a), batch.count);
        store(likely, of.prob + batch.number(part, a), batch.count);
    }
    store(entropy, of.entropy + batch.row(part, of.parts), batch.count);
    store(gap, of.gap + batch.row(part, of.parts), batch.count);
}

// Write the slope by the outputs of a part.
void back(const Batch &batch, const Slope &slope, int64_t part, Vec *by, float *by_outputs) {
    const Choices &of = batch.of;
    const bool learned = slope.action && part < slope.learned;
    const int64_t row = batch.row(0, 1);
    Vec by_log_prob = learned ? batch.read(slope.by_log_prob, batch.row(part, slope.learned)) : Vec{};
    Vec entropies = slope.entropy_weights ? batch.read(slope.entropy_weights, row) : Vec{} + slope.entropy_weight;
    Vec gaps = slope.gap_weights ? batch.read(slope.gap_weights, row) : Vec{} + slope.gap_weight;
    Ints taken = {};
    for (int64_t i = 0; learned && i < batch.count; i++) taken[i] = static_cast<int32_t>(slope.action[row + i]);
    Vec total = {};
    for (int64_t a = 0; a < of.actions; a++) {
        Vec own = batch.read(of.log_prob, batch.number(part, a)), likely = batch.read(of.prob, batch.number(part, a));
        by[a] = Vec{};
        if (learned) by[a] -= own * likely * entropies;
        if (learned) by[a] += taken == static_cast<int32_t>(a) ? by_log_prob : Vec{};
        if (part > 0 && slope.moves_copies)
            by[a] += likely * (own - batch.read(of.log_prob, batch.number(0, a))) * gaps;
        for (int64_t k = 1; part == 0 && slope.moves_originals && k < of.parts; k++)
            by[a] -= batch.read(of.prob, batch.number(k, a)) * gaps;
        total += by[a];
    }
    for (int64_t a = 0; a < of.actions; a++) {
        Vec own = by[a] - batch.read(of.prob, batch.number(part, a)) * total;
        for (int64_t i = 0; i < batch.count; i++) by_outputs[batch.output(part, i, a)] = own[i];
    }
}

}  // namespace

extern "C" {

void choose(const Choices *choices) {
    each_batch(*choices, 2 * choices->actions, [](const Batch &batch, Vec *room) {
        for (int64_t k = 0; k < batch.of.parts; k++) softmax(batch, k, room, room + batch.of.actions);
    });
}

void choose_backward(const Choices *choices, const Slope *slope, float *by_outputs) {
    each_batch(*choices, choices->actions, [=](const Batch &batch, Vec *room) {
        for (int64_t k = 0; k < batch.of.parts; k++) back(batch, *slope, k, room, by_outputs);
    });
}

}
