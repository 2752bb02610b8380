// Draws of MADDPG's actor and the gradient of its loss by the logits, for discrete actions: closed_actor.py of the
// algorithms.

#include "policies.h"

namespace {

// What actor.py fills in beside the policies. The first L parts are learned from; what is drawn, and the gradient by
// it, is [S, L, R, N, A].
struct Actor {
    int64_t learned, moves_originals, moves_copies;
    float output_penalty, gap;
    float *soft;         // as the logits
    const float *share;  // [S, R] of each row in the mean

    // Where an action of a part is among what is drawn; from there to the next row.
    int64_t drawn(const Batch &batch, int64_t part, int64_t action) const {
        int64_t row = (batch.seed * learned + part) * batch.of.rows + batch.begin;
        return row * step(batch) + batch.agent * batch.of.actions + action;
    }
    int64_t step(const Batch &batch) const { return batch.of.agents * batch.of.actions; }
};

Vec gather(const float *from, int64_t step, int64_t count) {
    Vec x = {};
    for (int64_t i = 0; i < count; i++) x[i] = from[i * step];
    return x;
}

void scatter(Vec x, float *to, int64_t step, int64_t count) {
    for (int64_t i = 0; i < count; i++) to[i * step] = x[i];
}

// Draw by Gumbel noise [A].
void draw_part(const Batch &batch, const Actor &actor, int64_t part, const Vec *gumbel, Vec *soft, float *hard) {
    const int64_t actions = batch.of.actions;
    Vec most = Vec{} - 3e38f, sum = {}, largest = {}, equal = {};
    for (int64_t a = 0; a < actions; a++) {
        soft[a] = load(batch.of.logits + batch.own(part, a), batch.count) + gumbel[a];
        most = soft[a] > most ? soft[a] : most;
    }
    for (int64_t a = 0; a < actions; a++) {
        soft[a] = exp_of(soft[a] - most);
        sum += soft[a];
    }
    for (int64_t a = 0; a < actions; a++) {
        soft[a] /= sum;
        largest = soft[a] > largest ? soft[a] : largest;
        store(soft[a], actor.soft + batch.own(part, a), batch.count);
    }
    for (int64_t a = 0; a < actions; a++) equal += soft[a] == largest ? Vec{} + 1.0f : Vec{};
    for (int64_t a = 0; a < actions; a++) {
        Vec one = soft[a] == largest ? 1.0f / equal : Vec{};
        scatter(one, hard + actor.drawn(batch, part, a), actor.step(batch), batch.count);
    }
}

// Set the gradient [A] of the divergence of copies from their originals by the logits of a part.
void diverge(const Batch &batch, const Actor &actor, int64_t part, const Vec *log_prob, const Vec *prob, Vec *by) {
    const int64_t actions = batch.of.actions;
    const Vec *own = log_prob + part * actions, *likely = prob + part * actions;
    Vec total = {};
    for (int64_t a = 0; a < actions; a++) {
        by[a] = part > 0 && actor.moves_copies ? likely[a] * (own[a] - log_prob[a]) : Vec{};
        total += by[a];
        for (int64_t k = 1; part == 0 && actor.moves_originals && k < batch.of.parts; k++)
            by[a] += prob[a] - prob[k * actions + a];
    }
    for (int64_t a = 0; a < actions; a++) by[a] -= likely[a] * total;
}

}  // namespace

extern "C" {

// Draw what the critic is asked about by noise [S, R, N, A], uniform in [0, 1), the same for all parts.
void draw(const Policies *policies, const Actor *actor, const float *noise, float *hard) {
    const int64_t actions = policies->actions;
    each_batch(*policies, 2 * actions, [=](const Batch &batch, Vec *gumbel) {
        const Policies &of = batch.of;
        const float *from = noise + ((batch.seed * of.rows + batch.begin) * of.agents + batch.agent) * actions;
        for (int64_t a = 0; a < actions; a++) {
            Vec u = gather(from + a, of.agents * actions, batch.count);
            u = u < 1e-7f ? Vec{} + 1e-7f : u > 1.0f - 1e-7f ? Vec{} + (1.0f - 1e-7f) : u;
            gumbel[a] = -log_of(-log_of(u));
        }
        for (int64_t k = 0; k < actor->learned; k++) draw_part(batch, *actor, k, gumbel, gumbel + actions, hard);
    });
}

// Compute the gradient of the loss, as the logits, and the entropies' mean over agents and learned parts [S, R].
void actor_gradient(const Policies *policies, const Actor *actor, const float *by_drawn, float *gradient,
                    float *entropy) {
    const int64_t actions = policies->actions, size = policies->parts * actions, learned = actor->learned;
    each_batch(*policies, 2 * size + 2 * actions, [=](const Batch &batch, Vec *room) {
        const Policies &of = batch.of;
        Vec *log_prob = room, *prob = room + size, *by = prob + size, *sent = by + actions;
        float *said = entropy + batch.seed * of.rows + batch.begin;
        Vec row = batch.data(actor->share) / static_cast<float>(of.agents);
        Vec uncertain = batch.agent ? load(said, batch.count) : Vec{};
        for (int64_t k = 0; k < of.parts; k++) softmax(batch, k, log_prob + k * actions, prob + k * actions);
        for (int64_t k = 0; k < of.parts; k++) {
            diverge(batch, *actor, k, log_prob, prob, by);
            Vec gap = row * (actor->gap / static_cast<float>(of.parts - 1)), mean = {}, total = {};
            for (int64_t a = 0; a < actions; a++) {
                const Vec &own = log_prob[k * actions + a];
                by[a] = actor->gap ? by[a] * gap : Vec{};
                mean += own / static_cast<float>(actions);
                if (k < learned) uncertain -= own * prob[k * actions + a] / static_cast<float>(of.agents * learned);
            }
            for (int64_t a = 0; k < learned && a < actions; a++) {
                const int64_t action = of.orders[(k * of.seeds + batch.seed) * actions + a];
                sent[a] = gather(by_drawn + actor->drawn(batch, k, action), actor->step(batch), batch.count);
                sent[a] *= load(actor->soft + batch.at(k, a), batch.count);
                total += sent[a];
            }
            for (int64_t a = 0; a < actions; a++) {
                if (k < learned) {
                    by[a] += sent[a] - load(actor->soft + batch.at(k, a), batch.count) * total;
                    by[a] += (log_prob[k * actions + a] - mean) * row *
                             (2.0f * actor->output_penalty / static_cast<float>(actions * learned));
                }
                store(by[a], gradient + batch.at(k, a), batch.count);
            }
        }
        store(uncertain, said, batch.count);
    });
}

}
