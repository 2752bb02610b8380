// Policies over A actions, for as many rows at once as a vector holds.

#pragma once

#include "vectors.h"

namespace {

// What the Python files fill in: logits [S, A, N, P, R] of N agents and P parts, the originals and copies of them.
struct Policies {
    int64_t seeds, agents, parts, actions, rows, threads;
    const float *logits;
    const int64_t *orders;  // [P, S, A]: which action of a part is the original's
};

// Some rows of a seed and an agent.
struct Batch {
    const Policies &of;
    int64_t seed, agent, begin, count;  // count <= LANES

    Vec data(const float *x) const { return load(x + seed * of.rows + begin, count); }  // of [S, R]
    // Where logits, and what lies as they do, have an action of a part; and what is action a of the original.
    int64_t own(int64_t part, int64_t action) const {
        return (((seed * of.actions + action) * of.agents + agent) * of.parts + part) * of.rows + begin;
    }
    int64_t at(int64_t part, int64_t a) const {
        return own(part, of.orders[(part * of.seeds + seed) * of.actions + a]);
    }
};

// Set log_prob [A] and prob [A] of a part, in the originals' order.
void softmax(const Batch &batch, int64_t part, Vec *log_prob, Vec *prob) {
    const Policies &of = batch.of;
    Vec most = load(of.logits + batch.at(part, 0), batch.count), sum = {};
    for (int64_t a = 0; a < of.actions; a++) {
        log_prob[a] = load(of.logits + batch.at(part, a), batch.count);
        most = log_prob[a] > most ? log_prob[a] : most;
    }
    for (int64_t a = 0; a < of.actions; a++) {
        log_prob[a] -= most;
        prob[a] = exp_of(log_prob[a]);
        sum += prob[a];
    }
    Vec log_sum = log_of(sum), share = 1.0f / sum;
    for (int64_t a = 0; a < of.actions; a++) {
        log_prob[a] -= log_sum;
        prob[a] *= share;
    }
}

// Let threads use all rows: use(batch, room for some vectors of P A and of A).
template <class Use>
void each_batch(const Policies &of, int64_t vectors, Use use) {
    const Shares shares(of.seeds, of.rows, 256, of.threads);
#pragma omp parallel num_threads(shares.busy)
    {
        Scratch own = scratch(vectors * LANES);
#pragma omp for schedule(static)
        for (int64_t task = 0; task < shares.tasks; task++)
            for (Span left = shares.of(task); left.size() > 0; left.begin += LANES)
                for (int64_t n = 0; n < of.agents; n++) {
                    int64_t count = std::min<int64_t>(LANES, left.size());
                    use(Batch{of, task / shares.parts, n, left.begin, count}, &vec(own.get()));
                }
    }
}

}  // namespace
