// Choices among A actions by softmax, as many rows at once as a vector holds: choices.py of the networks.
//
// Parts are the originals and copies of them. Data are [S, R] or [S, L, R] of the L parts that are learned from.

#include "perceptron.h"

namespace {

// What choices.py fills in.
struct Choices {
    int64_t seeds, parts, rows, actions, threads;
    int64_t by_seed, by_part, by_row, by_action;  // steps between the outputs [S, P, R, A]
    const int64_t *orders;               // [S, P, A]: which output of a part is the original's action
    const float *outputs;

    // Two numbers of each action, of a vector of rows of all parts and of one part more.
    int64_t room() const { return 2 * (parts + 1) * actions * LANES; }
};

// What losses add to the slope by the outputs. No data: they do not, or the weight is a number.
struct Slope {
    int64_t learned, moves, old_parts;
    float entropy_weight, gap_weight, clip, clip_weight;
    const int64_t *action;                        // [S, R]
    const float *entropy_weights, *gap_weights;   // [S, R] each
    const float *old, *advantage, *clip_weights;  // [S, 1 or L, R], [S, R], [S, R]
};

// Some rows of a seed.
struct Batch {
    const Choices &of;
    int64_t seed, begin, count;  // count <= LANES

    int64_t output(int64_t part, int64_t lane, int64_t a) const {
        return seed * of.by_seed + part * of.by_part + (begin + lane) * of.by_row +
               of.orders[(seed * of.parts + part) * of.actions + a] * of.by_action;
    }
    int64_t row(int64_t part, int64_t parts) const { return (seed * parts + part) * of.rows + begin; }
    Vec read(const float *x, int64_t at) const { return load(x + at, count); }
};

// Compute the log-probabilities of a part, and its probabilities behind them.
void softmax(const Batch &batch, int64_t part, Vec *log_prob) {
    const int64_t actions = batch.of.actions;
    Vec most = {}, sum = {};
    for (int64_t a = 0; a < actions; a++) {
        Vec x = {};
        for (int64_t i = 0; i < batch.count; i++) x[i] = batch.of.outputs[batch.output(part, i, a)];
        most = a == 0 ? x : x > most ? x : most;
        log_prob[a] = x;
    }
    for (int64_t a = 0; a < actions; a++) sum += exp_of(log_prob[a] - most);
    Vec log_sum = most + log_of(sum);
    for (int64_t a = 0; a < actions; a++) {
        log_prob[a] -= log_sum;
        log_prob[actions + a] = exp_of(log_prob[a]);
    }
}

// The slope of the clipped objective by the log-probability of what was done: rho A, or 0.
Vec clipped(const Batch &batch, const Slope &slope, int64_t part, Vec log_prob) {
    const int64_t row = batch.row(0, 1), old = batch.row(slope.old_parts > 1 ? part : 0, slope.old_parts);
    Vec ratio = exp_of(log_prob - batch.read(slope.old, old)), advantage = batch.read(slope.advantage, row);
    Vec least = Vec{} + (1 - slope.clip), most = Vec{} + (1 + slope.clip);
    Vec bound = ratio < least ? least : ratio > most ? most : ratio, gain = ratio * advantage;
    Vec weight = slope.clip_weights ? batch.read(slope.clip_weights, row) : Vec{} + slope.clip_weight;
    return gain > bound * advantage ? Vec{} : gain * weight;
}

// Write the slope by the outputs of a part.
void back_part(const Batch &batch, const Slope &slope, int64_t part, const Vec *known, Vec *by, float *by_outputs) {
    const Choices &of = batch.of;
    const bool learned = slope.action && part < slope.learned;
    const int64_t row = batch.row(0, 1), step = 2 * of.actions;
    const Vec *log_prob = known + part * step, *prob = log_prob + of.actions;
    Vec entropies = slope.entropy_weights ? batch.read(slope.entropy_weights, row) : Vec{} + slope.entropy_weight;
    Vec gaps = slope.gap_weights ? batch.read(slope.gap_weights, row) : Vec{} + slope.gap_weight;
    Ints taken = {};
    for (int64_t i = 0; learned && i < batch.count; i++) taken[i] = static_cast<int32_t>(slope.action[row + i]);
    Vec total = {}, by_log_prob = {};
    for (int64_t a = 0; a < of.actions; a++) by_log_prob = taken == static_cast<int32_t>(a) ? log_prob[a] : by_log_prob;
    if (learned) by_log_prob = clipped(batch, slope, part, by_log_prob);
    for (int64_t a = 0; a < of.actions; a++) {
        by[a] = Vec{};
        if (learned) by[a] -= log_prob[a] * prob[a] * entropies;
        if (learned) by[a] += taken == static_cast<int32_t>(a) ? by_log_prob : Vec{};
        if (part > 0 && slope.moves) by[a] += prob[a] * (log_prob[a] - known[a]) * gaps;
        for (int64_t k = 1; part == 0 && slope.moves && k < of.parts; k++)
            by[a] -= known[k * step + of.actions + a] * gaps;
        total += by[a];
    }
    for (int64_t a = 0; a < of.actions; a++) {
        Vec own = by[a] - prob[a] * total;
        for (int64_t i = 0; i < batch.count; i++) by_outputs[batch.output(part, i, a)] = own[i];
    }
}

// Write the slope by the outputs of all parts of some rows.
void back_rows(const Choices &of, int64_t seed, Span rows, const Slope &slope, float *room, float *by_outputs) {
    const int64_t step = 2 * of.actions;
    for (Vec *known = &vec(room); rows.size() > 0; rows.begin += LANES) {
        const Batch batch{of, seed, rows.begin, std::min<int64_t>(LANES, rows.size())};
        for (int64_t k = 0; k < of.parts; k++) softmax(batch, k, known + k * step);
        for (int64_t k = 0; k < of.parts; k++)
            back_part(batch, slope, k, known, known + of.parts * step, by_outputs);
    }
}

}  // namespace

extern "C" {

// Compute the slope by the outputs, as they lie.
void choose_backward(const Choices *choices, const Slope *slope, float *by_outputs) {
    const Shares shares(choices->seeds, choices->rows, 256, choices->threads);
    auto work = [&](int64_t task, float *room) {
        back_rows(*choices, task / shares.parts, shares.of(task), *slope, room, by_outputs);
    };
    share_out(shares, 0, choices->room(), [](int64_t) {}, work, [](int64_t) {});
}

// Compute the gradients by the parameters of a perceptron whose outputs are the choices; rows are [R, P].
void learn_choices(const Perceptron *given, const Choices *choices, const Slope *slope, float *by_parameters) {
    learn_from(Layout(*given), by_parameters, [&](int64_t seed, Span span, int64_t width, float *outputs) {
        Choices here = *choices;
        here.by_seed = 0, here.by_part = width, here.by_row = here.parts * width, here.by_action = 1;
        Span left{span.begin / here.parts, span.end / here.parts};
        here.outputs = outputs -= left.begin * here.by_row;
        Scratch room = scratch(here.room());
        back_rows(here, seed, left, *slope, room.get(), outputs);
    });
}

}
