// The gradient of MAPPO's losses by the logits, for discrete actions: closed_form.policy_gradient of the algorithms.

#include "policies.h"

namespace {

// What policy_gradient.py fills in beside the policies; data are [S, R] of the originals.
struct Objective {
    int64_t augments, moves_originals, moves_copies;
    float clip_epsilon, entropy_coef, gap;
    const int64_t *action;
    const float *old_log_prob, *advantage;
    float *gradient;  // as the logits
};

// Return the slope of PPO's objective by the log-probability of what was done.
Vec surrogate_slope(const Batch &batch, const Objective &objective, Vec log_prob) {
    Vec ratio = exp_of(log_prob - batch.data(objective.old_log_prob)), advantage = batch.data(objective.advantage);
    Vec gain = ratio * advantage;
    float least = 1.0f - objective.clip_epsilon, most = 1.0f + objective.clip_epsilon;
    ratio = ratio < least ? Vec{} + least : ratio > most ? Vec{} + most : ratio;
    return gain > ratio * advantage ? Vec{} : gain;
}

// Set the gradient by the log-probabilities of a part, and pull it back to its logits; log_prob and prob are [P, A].
void pull(const Batch &batch, const Objective &objective, int64_t part, const Vec *log_prob, const Vec *prob,
          Vec *gradient) {
    const Policies &of = batch.of;
    const Vec *own = log_prob + part * of.actions, *likely = prob + part * of.actions;
    bool learns = objective.augments || part == 0;
    float rows = static_cast<float>(of.rows);
    float share = 1.0f / (static_cast<float>(objective.augments ? of.parts : 1) * rows);
    float gap = objective.gap / (static_cast<float>(of.parts - 1) * rows);
    Ints taken = {};
    for (int64_t r = 0; r < batch.count; r++)
        taken[r] = static_cast<int32_t>(objective.action[batch.seed * of.rows + batch.begin + r]);
    Vec done = own[0], total = {};
    for (int64_t a = 1; a < of.actions; a++) done = taken == static_cast<int32_t>(a) ? own[a] : done;
    Vec slope = surrogate_slope(batch, objective, done) * share;
    for (int64_t a = 0; a < of.actions; a++) {
        Vec by = {};
        if (learns) by = own[a] * likely[a] * (objective.entropy_coef * share);
        if (learns) by -= taken == static_cast<int32_t>(a) ? slope : Vec{};
        if (part > 0 && objective.moves_copies) by += (own[a] - log_prob[a]) * likely[a] * gap;
        for (int64_t k = 1; part == 0 && objective.moves_originals && k < of.parts; k++)
            by -= prob[k * of.actions + a] * gap;
        total += by;
        gradient[a] = by;
    }
    for (int64_t a = 0; a < of.actions; a++)
        store(gradient[a] - likely[a] * total, objective.gradient + batch.at(part, a), batch.count);
}

}  // namespace

extern "C" void policy_gradient(const Policies *policies, const Objective *objective) {
    const int64_t actions = policies->actions, size = policies->parts * actions;
    each_batch(*policies, 2 * size + actions, [=](const Batch &batch, Vec *room) {
        Vec *log_prob = room, *prob = room + size, *gradient = prob + size;
        for (int64_t k = 0; k < batch.of.parts; k++) softmax(batch, k, log_prob + k * actions, prob + k * actions);
        for (int64_t k = 0; k < batch.of.parts; k++) pull(batch, *objective, k, log_prob, prob, gradient);
    });
}
