// The gradient of MAPPO's losses by the logits, for discrete actions: closed_form.policy_gradient of the algorithms, for
// as many rows at once as a vector holds.

#include "vectors.h"

constexpr int64_t ROWS = 256;

namespace {

// What policy_gradient.py fills in. Data are [S, R] of the originals; logits and gradients [S, A, P, R], where P is 1
// for the originals and 1 for each copy of them.
struct Policy {
    int64_t seeds, rows, parts, actions, threads, augments, moves_originals, moves_copies;
    float clip_epsilon, entropy_coef, gap;
    const float *logits;
    const int64_t *orders;  // [P, S, A]: which action of a part is the original's
    const int64_t *action;
    const float *old_log_prob, *advantage;
    float *gradient;
};

struct Rows {
    const Policy &policy;
    int64_t seed, begin, count;  // count <= LANES

    Vec data(const float *of) const { return load(of + seed * policy.rows + begin, count); }
    // Where a part has its logit, or the gradient by it, for what is action a of the original.
    int64_t at(int64_t part, int64_t a) const {
        int64_t own = policy.orders[(part * policy.seeds + seed) * policy.actions + a];
        return ((seed * policy.actions + own) * policy.parts + part) * policy.rows + begin;
    }
};

// Set log_prob [A] and prob [A] of a part.
void softmax(const Rows &rows, int64_t part, Vec *log_prob, Vec *prob) {
    int64_t actions = rows.policy.actions;
    Vec most = load(rows.policy.logits + rows.at(part, 0), rows.count), sum = {};
    for (int64_t a = 0; a < actions; a++) {
        log_prob[a] = load(rows.policy.logits + rows.at(part, a), rows.count);
        most = log_prob[a] > most ? log_prob[a] : most;
    }
    for (int64_t a = 0; a < actions; a++) {
        log_prob[a] -= most;
        prob[a] = exp_of(log_prob[a]);
        sum += prob[a];
    }
    Vec log_sum = log_of(sum), share = 1.0f / sum;
    for (int64_t a = 0; a < actions; a++) {
        log_prob[a] -= log_sum;
        prob[a] *= share;
    }
}

// Return the slope of PPO's objective by the log-probability of what was done.
Vec surrogate_slope(const Rows &rows, Vec log_prob) {
    const Policy &policy = rows.policy;
    Vec ratio = exp_of(log_prob - rows.data(policy.old_log_prob)), advantage = rows.data(policy.advantage);
    Vec gain = ratio * advantage;
    float least = 1.0f - policy.clip_epsilon, most = 1.0f + policy.clip_epsilon;
    ratio = ratio < least ? Vec{} + least : ratio > most ? Vec{} + most : ratio;
    return gain > ratio * advantage ? Vec{} : gain;
}

// Set the gradient by the log-probabilities of a part, and pull it back to its logits; log_prob and prob are [P, A].
void pull(const Rows &rows, int64_t part, const Vec *log_prob, const Vec *prob, Vec *gradient) {
    const Policy &policy = rows.policy;
    int64_t actions = policy.actions;
    const Vec *own = log_prob + part * actions, *likely = prob + part * actions;
    bool learns = policy.augments || part == 0;
    float share = 1.0f / (static_cast<float>(policy.augments ? policy.parts : 1) * static_cast<float>(policy.rows));
    float gap = policy.gap / (static_cast<float>(policy.parts - 1) * static_cast<float>(policy.rows));
    Ints taken = {};
    for (int64_t r = 0; r < rows.count; r++)
        taken[r] = static_cast<int32_t>(policy.action[rows.seed * policy.rows + rows.begin + r]);
    Vec done = own[0], total = {};
    for (int64_t a = 1; a < actions; a++) done = taken == static_cast<int32_t>(a) ? own[a] : done;
    Vec slope = surrogate_slope(rows, done) * share;
    for (int64_t a = 0; a < actions; a++) {
        Vec by = {};
        if (learns) by = own[a] * likely[a] * (policy.entropy_coef * share);
        if (learns) by -= taken == static_cast<int32_t>(a) ? slope : Vec{};
        if (part > 0 && policy.moves_copies) by += (own[a] - log_prob[a]) * likely[a] * gap;
        for (int64_t k = 1; part == 0 && policy.moves_originals && k < policy.parts; k++)
            by -= prob[k * actions + a] * gap;
        total += by;
        gradient[a] = by;
    }
    for (int64_t a = 0; a < actions; a++)
        store(gradient[a] - likely[a] * total, policy.gradient + rows.at(part, a), rows.count);
}

}  // namespace

extern "C" void policy_gradient(const Policy *given) {
    const Policy &policy = *given;
    const Shares shares(policy.seeds, policy.rows, ROWS, policy.threads);
    int64_t actions = policy.actions, size = policy.parts * actions;
#pragma omp parallel num_threads(shares.busy)
    {
        Scratch own = scratch((2 * size + actions) * LANES);
        Vec *log_prob = &vec(own.get()), *prob = log_prob + size, *gradient = prob + size;
#pragma omp for schedule(static)
        for (int64_t task = 0; task < shares.tasks; task++)
            for (Span left = shares.of(task); left.size() > 0; left.begin += LANES) {
                Rows rows{policy, task / shares.parts, left.begin, std::min<int64_t>(LANES, left.size())};
                for (int64_t k = 0; k < policy.parts; k++) softmax(rows, k, log_prob + k * actions, prob + k * actions);
                for (int64_t k = 0; k < policy.parts; k++) pull(rows, k, log_prob, prob, gradient);
            }
    }
}
