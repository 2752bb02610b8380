// The passes of perceptron.py.

#include "perceptron.h"

extern "C" {

// Compute the outputs, and keep what hidden layers give where there is room for it.
void forward(const Perceptron *given, const Rows *outputs) {
    const Layout net(*given);
    pass(net, [&](int64_t seed, Span span, Matrix from) {
        float *to = outputs->at + seed * outputs->seed + span.begin * outputs->row;
        copy(span.size(), net.out(net.layers - 1), from, to, outputs->row, outputs->column);
    });
}

// Compute the gradients by the parameters and by the inputs, from that by the outputs.
void backward(const Perceptron *given, const Rows *by_outputs, float *by_parameters, const Below *below) {
    const Layout net(*given);
    const int64_t last = net.out(net.layers - 1);
    auto fill = [&](const Layout &, int64_t seed, Span span, float *to) {
        const float *from = by_outputs->at + seed * by_outputs->seed + span.begin * by_outputs->row;
        if (padded(last) > last) std::fill(to, to + span.size() * padded(last), 0.0f);
        copy(span.size(), last, {from, by_outputs->row, by_outputs->column}, to, padded(last), 1);
    };
    pull(net, by_parameters, *below, [](int64_t) {}, fill);
}

}
