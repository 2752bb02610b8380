// Passes of S seeds through a perceptron at once, in blocks of rows that stay in a core's cache through all layers.
//
// Parameters are [S, in, out] and [S, 1, out], inputs [S, R, in] in parts that may lie anyhow in memory. What hidden
// layers give is kept as [S, R, padded(out)], layer after layer. A seed's gradient is summed over parts of its rows
// that depend on R alone, so the results depend neither on the other seeds nor on the number of threads.

#pragma once

#include "vectors.h"

constexpr int64_t BLOCK = 128, PART = 256;
constexpr int AXES = 3;

namespace {

// ---- What perceptron.py fills in

// Columns of the inputs, whose R rows are counted along axes, the last one fastest.
struct Columns {
    const float *at;
    int64_t width, seed, column;  // how many; steps to the next seed and to the next column
    int64_t sizes[AXES], strides[AXES];

    bool in_rows() const { return column == 1 && sizes[0] == 1 && sizes[1] == 1; }
    const float *row(int64_t s, int64_t r) const {
        int64_t last = r / sizes[2];
        return at + s * seed + last / sizes[1] * strides[0] + last % sizes[1] * strides[1] + r % sizes[2] * strides[2];
    }
    void gather(int64_t s, Span rows, float *to, int64_t to_row) const {
        for (int64_t r = rows.begin, end; r < rows.end; r = end) {
            end = std::min(rows.end, (r / sizes[2] + 1) * sizes[2]);
            copy(end - r, width, {row(s, r), strides[2], column}, to + (r - rows.begin) * to_row, to_row, 1);
        }
    }
};

struct Perceptron {
    int64_t seeds, rows, layers, tanh, activate_output, threads, parts;
    int64_t things;                  // rows that stay together, R is a multiple of it; else 1
    const int64_t *widths;           // layers + 1
    const float *const *parameters;  // W_1, b_1, ... of the first seed
    const int64_t *strides;          // of each parameter, from seed to seed
    const Columns *inputs;           // parts of them, side by side
    float *hidden;                   // what hidden layers give, and an activated output; null: computed again
};

// A matrix [S, R, .] to write or to read.
struct Rows {
    float *at;
    int64_t seed, row, column;  // steps to the next one
};

// Where the gradient by some columns of the inputs goes.
struct Below {
    float *at;  // [S, R, columns]; null: nowhere
    Span columns;
};

// ---- Passes

struct Layout : Perceptron {
    Shares shares;  // of rows / things
    int64_t together, block, widest;  // of a block: groups of rows that stay together, and rows
    int64_t first = 0, kept_rows = seeds * rows;  // of `hidden`

    explicit Layout(const Perceptron &given)
        : Perceptron(given), shares(seeds, rows / things, std::max<int64_t>(1, PART / things), threads),
          together(std::max<int64_t>(1, BLOCK / things)), block(together * things), widest(PAD) {
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
        return hidden + below * kept_rows + (seed * rows + row - first) * padded(out(k));
    }
    // The same with room to keep what hidden layers give to a block that begins at some row.
    Layout kept_at(float *room, int64_t seed, int64_t row) const {
        Layout net = *this;
        net.hidden = room, net.first = seed * rows + row, net.kept_rows = block;
        return net;
    }
    // What layer k > 0 reads, which was kept.
    Matrix kept(int64_t k, int64_t seed, int64_t row) const {
        return {given(k - 1, seed, row), padded(in(k)), 1};
    }
    // Go through the rows of a task; see `Shares::blocks`.
    template <class Use>
    void blocks(int64_t task, Use use) const {
        shares.blocks(task, together, [&](int64_t seed, Span span, bool add) {
            use(seed, Span{span.begin * things, span.end * things}, add);
        });
    }
    // What the first layer reads: where it lies, or copied to a room of a block.
    Matrix read(int64_t seed, Span span, float *room) const {
        if (parts == 1 && inputs->in_rows()) return {inputs->row(seed, span.begin), inputs->strides[AXES - 1], 1};
        int64_t column = 0;
        for (const Columns *part = inputs; part < inputs + parts; column += part++->width)
            part->gather(seed, span, room + column, in(0));
        return {room, in(0), 1};
    }
    // Whether the gradient of a weight is computed as [out, in], so that thin outputs are not filled up.
    bool turned(int64_t k) const { return k > 0 && out(k) < PAD; }
    int64_t weight_room(int64_t k) const { return turned(k) ? out(k) * padded(in(k)) : in(k) * padded(out(k)); }
    int64_t packed_room() const {
        int64_t room = 0;
        for (int64_t k = 0; k < layers; k++) room += (in(k) + 1) * padded(out(k));
        return room;
    }
    int64_t hidden_room() const {
        int64_t room = 0;
        for (int64_t k = 0; k < layers; k++) room += activates(k) ? block * padded(out(k)) : 0;
        return room;
    }
    // Of a thread: blocks of what two layers give, and of the inputs.
    int64_t block_room() const { return block * (2 * widest + in(0)); }
    float *inputs_room(float *own) const { return own + 2 * block * widest; }
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

// Compute what layer k, whose packed parameters are given, makes of a block of rows.
void apply(const Layout &net, int64_t k, int64_t rows, Matrix from, const float *weight, float *to) {
    int64_t width = padded(net.out(k));
    product(rows, width, net.in(k), from, weight, width, weight + net.in(k) * width, false, to, width);
    if (net.activates(k)) activate(to, rows * width, net.tanh);
}

// Pass a block of rows through all layers, whose packed parameters are given; return what the last one gives,
// [rows, padded(out)]. What hidden layers give is kept where there is room for it.
Matrix pass_block(const Layout &net, int64_t seed, Span span, const float *weight, float *own) {
    Matrix from = net.read(seed, span, net.inputs_room(own));
    for (int64_t k = 0; k < net.layers; k++) {
        bool kept = net.hidden && net.activates(k);
        float *to = kept ? net.given(k, seed, span.begin) : own + (k % 2) * net.block * net.widest;
        apply(net, k, span.size(), from, weight, to);
        from = {to, padded(net.out(k)), 1};
        weight += (net.in(k) + 1) * padded(net.out(k));
    }
    return from;
}

// Pass blocks of rows through all layers: use(seed, rows, what the last layer gives); see `pass_block`.
template <class Use>
void pass(const Layout &net, Use use) {
    const int64_t room = net.packed_room();
    Scratch packed = scratch(net.seeds * room);
    share_out(
        net.shares, 0, net.block_room(), [&](int64_t s) { pack(net, s, packed.get() + s * room); },
        [&](int64_t task, float *own) {
            net.blocks(task, [&](int64_t seed, Span span, bool) {
                use(seed, span, pass_block(net, seed, span, packed.get() + seed * room, own));
            });
        },
        [](int64_t) {});
}

// Of the gradient that layer k sends down: its columns.
Span sent(const Layout &net, int64_t k, const Below &below) { return k ? Span{0, net.in(k)} : below.columns; }

// Copy a seed's weights, layer after layer, as [out, padded(columns)] of what is sent down.
void turn(const Layout &net, int64_t seed, const Below &below, float *to) {
    for (int64_t k = 0; k < net.layers; k++) {
        Span columns = sent(net, k, below);
        for (int64_t o = 0; o < net.out(k); o++, to += padded(columns.size())) {
            for (int64_t i = columns.begin; i < columns.end; i++)
                to[i - columns.begin] = net.weight(k, seed)[i * net.out(k) + o];
            std::fill(to + columns.size(), to + padded(columns.size()), 0.0f);
        }
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

// Pull the gradient by a block of outputs, [rows, padded(out)], back through all layers. It lies in the first of the
// two blocks of `own`; the weights, turned, and the sums end where they are given.
void pull_block(const Layout &net, int64_t seed, Span span, bool add, const float *weight, float *sum,
                const Below &below, float *own) {
    float *here = own, *next = own + net.block * net.widest;
    for (int64_t k = net.layers - 1; k >= 0; k--) {
        int64_t width = padded(net.out(k)), down = padded(sent(net, k, below).size());
        if (net.activates(k)) times_slope(here, net.given(k, seed, span.begin), span.size() * width, net.tanh);
        if (sum) {
            sum -= net.weight_room(k) + width;
            Matrix from = k ? net.kept(k, seed, span.begin) : net.read(seed, span, net.inputs_room(own));
            learn(net, k, from, here, span.size(), add, sum);
        }
        weight -= net.out(k) * down;
        if (k == 0 && !below.at) return;
        product(span.size(), down, net.out(k), {here, width, 1}, weight, down, nullptr, false, next, down);
        std::swap(here, next);
    }
    int64_t columns = below.columns.size();
    float *to = below.at + (seed * net.rows + span.begin) * columns;
    copy(span.size(), columns, {here, padded(columns), 1}, to, columns, 1);
}

// Add up the sums of a seed's parts, `room` numbers each, in the first of them, and write its gradients [P].
void add_up(const Layout &net, int64_t room, float *sums, float *gradients) {
    for (int64_t i = 0; i < room; i += LANES) {
        Vec total = vec(sums + i);
        for (int64_t part = 1; part < net.shares.parts; part++) total += vec(sums + part * room + i);
        vec(sums + i) = total;
    }
    for (int64_t k = 0; k < net.layers; k++) {
        int64_t in = net.in(k), out = net.out(k);
        Matrix by_weight{sums, net.turned(k) ? 1 : padded(out), net.turned(k) ? padded(in) : 1};
        copy(in, out, by_weight, gradients, out, 1);
        sums += net.weight_room(k), gradients += in * out;
        std::copy(sums, sums + out, gradients);
        sums += padded(out), gradients += out;
    }
}

// Pull gradients back: to the parameters, [S, P] in their order, and to the inputs, each where there is room for it.
// prepare(seed) comes first; fill(net, seed, rows, to) writes the gradient by a block of outputs, [rows, padded(out)],
// filled up with zeros. What hidden layers gave is computed again where it was not kept.
template <class Prepare, class Fill>
void pull(const Layout &net, float *by_parameters, const Below &below, Prepare prepare, Fill fill) {
    int64_t turned_room = 0, sum_room = 0, count = 0;
    for (int64_t k = 0; k < net.layers; k++) {
        turned_room += net.out(k) * padded(sent(net, k, below).size());
        sum_room += net.weight_room(k) + padded(net.out(k));
        count += (net.in(k) + 1) * net.out(k);
    }
    int64_t sum_count = by_parameters ? net.shares.tasks * sum_room : 0;
    const int64_t room = net.hidden ? 0 : net.packed_room();
    Scratch turned = scratch(net.seeds * turned_room), sums = scratch(sum_count), packed = scratch(net.seeds * room);
    if (net.rows == 0) std::fill(sums.get(), sums.get() + sum_count, 0.0f);
    share_out(
        net.shares, 0, net.block_room() + (net.hidden ? 0 : net.hidden_room()),
        [&](int64_t s) {
            turn(net, s, below, turned.get() + s * turned_room);
            if (!net.hidden) pack(net, s, packed.get() + s * room);
            prepare(s);
        },
        [&](int64_t task, float *own) {
            net.blocks(task, [&](int64_t seed, Span span, bool add) {
                float *sum = by_parameters ? sums.get() + (task + 1) * sum_room : nullptr;
                const Layout at = net.hidden ? net : net.kept_at(own + net.block_room(), seed, span.begin);
                if (!net.hidden) pass_block(at, seed, span, packed.get() + seed * room, own);
                fill(at, seed, span, own);
                pull_block(at, seed, span, add, turned.get() + (seed + 1) * turned_room, sum, below, own);
            });
        },
        [&](int64_t s) {
            if (by_parameters)
                add_up(net, sum_room, sums.get() + s * net.shares.parts * sum_room, by_parameters + s * count);
        });
}

// Compute the gradients by the parameters of a loss whose rows stay together: change(seed, rows, width, outputs) turns
// a block of outputs, [rows, width], into the slopes by them in place; numbers behind the outputs are 0 and stay so.
template <class Change>
void learn_from(const Layout &net, float *by_parameters, Change change) {
    const int64_t width = padded(net.out(net.layers - 1));
    auto fill = [&](const Layout &, int64_t seed, Span span, float *own) {
        const float *other = own + net.block * net.widest;
        if (net.layers % 2 == 0) std::copy(other, other + span.size() * width, own);
        change(seed, span, width, own);
    };
    pull(net, by_parameters, Below{}, [](int64_t) {}, fill);
}

}  // namespace
