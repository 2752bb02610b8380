// The passes of perceptron.py, and its loss of values.

#include "perceptron.h"

// What perceptron.py fills in: Huber losses of the first parts of rows [R, P], and squared gaps between each copy and the
// original.
struct Regression {
    int64_t learned;
    float delta, weight, gap_weight;
    const float *target;  // [S, R]
};

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

// Compute the gradients by the parameters of a perceptron with one output.
void learn_values(const Perceptron *given, const Regression *of, float *by_parameters) {
    const Layout net(*given);
    const int64_t parts = net.things;
    learn_from(net, by_parameters, [&](int64_t seed, Span span, int64_t width, float *outputs) {
        const float *target = of->target + (seed * net.rows + span.begin) / parts;
        for (int64_t r = 0; r < span.size() / parts; r++, outputs += parts * width) {
            const float original = outputs[0];
            float gaps = 0;
            for (int64_t k = 0; k < parts; k++) {
                float value = outputs[k * width], gap = of->gap_weight * 2 * (value - original);
                float error = std::clamp(value - target[r], -of->delta, of->delta);
                outputs[k * width] = (k < of->learned ? of->weight * error : 0) + gap;
                gaps += gap;
            }
            outputs[0] -= gaps;
        }
    });
}

}
