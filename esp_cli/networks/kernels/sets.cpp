// Distances among the things of a row, and a perceptron over the things of sets with their mean and maximum.

#include "perceptron.h"

#include <cmath>

namespace {

constexpr int64_t ROWS = 64;  // of a task

template <class Work>
void each_rows(int64_t rows, int64_t threads, int64_t room, Work work) {
    const Shares shares(1, rows, ROWS, threads);
    share_out(
        shares, 0, room, [](int64_t) {}, [&](int64_t task, float *own) { work(shares.of(task), own); }, [](int64_t) {});
}

Vec root(Vec x) {
    for (int i = 0; i < LANES; i++) x[i] = std::sqrt(x[i]);
    return x;
}

}  // namespace

extern "C" {

// Describe things by their distance and by that to the nearest other one of each family.
// places: [rows, things, 2]; sizes: things of each family; to: [rows, things, 1 + families].
void distances(const int64_t *shape, const int64_t *sizes, const float *places, float *to) {
    const int64_t rows = shape[0], things = shape[1], families = shape[2], columns = families + 1;
    // LANES rows at a time, a vector for each coordinate of each thing
    each_rows(rows, shape[3], 2 * things * LANES, [&](Span span, float *own) {
        for (int64_t begin = span.begin; begin < span.end; begin += LANES) {
            int64_t count = std::min<int64_t>(LANES, span.end - begin);
            for (int64_t k = 0; k < 2 * things; k++)
                for (int64_t r = 0; r < LANES; r++)
                    own[k * LANES + r] = places[(begin + std::min(r, count - 1)) * 2 * things + k];
            auto write = [&](int64_t thing, int64_t column, Vec value) {
                for (int64_t r = 0; r < count; r++) to[((begin + r) * things + thing) * columns + column] = value[r];
            };
            Vec farthest = {};
            for (int64_t i = 0; i < things; i++) {
                Vec x = vec(own + 2 * i * LANES), y = vec(own + (2 * i + 1) * LANES), square = x * x + y * y;
                farthest = square > farthest ? square : farthest;
            }
            for (int64_t i = 0; i < things; i++) {
                Vec x = vec(own + 2 * i * LANES), y = vec(own + (2 * i + 1) * LANES);
                write(i, 0, root(x * x + y * y));
                for (int64_t family = 0, first = 0; family < families; first += sizes[family++]) {
                    bool alone = sizes[family] == 1 && i == first;
                    Vec least = alone ? 4.0f * farthest : Vec{} + INFINITY;
                    for (int64_t j = first; j < first + sizes[family]; j++) {
                        Vec dx = x - vec(own + 2 * j * LANES), dy = y - vec(own + (2 * j + 1) * LANES);
                        Vec square = dx * dx + dy * dy;
                        if (i != j) least = square < least ? square : least;
                    }
                    write(i, 1 + family, root(least));
                }
            }
        }
    });
}

// Sort the things of rows [rows, row] by the distance of their places, which begin at number `at` of a thing, from that
// at column `reader`, or from the origin where it is negative. columns: [things, width], where a thing's numbers are.
void sort(const int64_t *shape, const int64_t *columns, float *rows) {
    const int64_t row = shape[1], things = shape[2], width = shape[3], at = shape[4], reader = shape[5];
    each_rows(shape[0], shape[6], things * (width + 2), [&](Span span, float *own) {
        float *moved = own + things;                // [things, width]
        float *order = moved + things * width;      // small whole numbers
        for (int64_t r = span.begin; r < span.end; r++) {
            float *x = rows + r * row, here[] = {reader < 0 ? 0 : x[reader], reader < 0 ? 0 : x[reader + 1]};
            for (int64_t k = 0; k < things; k++) {
                float a = x[columns[k * width + at]] - here[0], b = x[columns[k * width + at + 1]] - here[1];
                float square = a * a + b * b;
                int64_t place = k;
                for (; place > 0 && own[place - 1] > square; place--) {
                    own[place] = own[place - 1];
                    order[place] = order[place - 1];
                }
                own[place] = square;
                order[place] = k;
            }
            for (int64_t k = 0; k < things * width; k++) moved[k] = x[columns[k]];
            for (int64_t k = 0; k < things; k++)
                for (int64_t c = 0; c < width; c++)
                    x[columns[k * width + c]] = moved[static_cast<int64_t>(order[k]) * width + c];
        }
    });
}

// Pass the things of sets, [S, R K, in], through a perceptron that ends with an activation, and write mean and maximum
// over each set, [S, R, 2 out], and what it gives of each thing, [S, R K, out], where there is room for it.
void pool(const Perceptron *given, const Rows *pooled, const Rows *each) {
    const Layout net(*given);
    const int64_t things = net.things, width = net.out(net.layers - 1);
    pass(net, [&](int64_t seed, Span span, Matrix from) {
        if (each->at)
            copy(span.size(), width, from, each->at + seed * each->seed + span.begin * each->row, each->row, 1);
        float *to = pooled->at + seed * pooled->seed + span.begin / things * pooled->row;
        for (const float *set = from.at; set < from.at + span.size() * from.row; set += things * from.row) {
            for (int64_t c = 0; c < width; c += LANES) {
                Vec sum = vec(set + c), most = sum;
                for (int64_t k = 1; k < things; k++) {
                    Vec x = vec(set + k * from.row + c);
                    sum += x;
                    most = x > most ? x : most;
                }
                store(sum * (1.0f / things), to + c, width - c);
                store(most, to + width + c, width - c);
            }
            to += pooled->row;
        }
    });
}

// Compute the gradients by the parameters and by the inputs, from those by what `pool` writes and, where given, by what
// the perceptron gives of each thing. The first of equal maxima takes all of its share.
void pool_backward(const Perceptron *given, const Rows *by_pooled, const Rows *by_each, float *by_parameters,
                   const Below *below) {
    const Layout whole(*given);
    const int64_t things = whole.things, last = whole.layers - 1, width = whole.out(last), row = padded(width);
    auto fill = [&](const Layout &net, int64_t seed, Span span, float *to) {
        const float *set = net.given(last, seed, span.begin);
        const float *from = by_pooled->at + seed * by_pooled->seed + span.begin / things * by_pooled->row;
        for (int64_t r = 0; r < span.size(); r += things, from += by_pooled->row, set += things * row) {
            for (int64_t c = 0; c < row; c += LANES) {
                Vec most = vec(set + c);
                for (int64_t k = 1; k < things; k++) {
                    Vec x = vec(set + k * row + c);
                    most = x > most ? x : most;
                }
                Vec share = load(from + c, width - c) * (1.0f / things), rest = load(from + width + c, width - c);
                for (int64_t k = 0; k < things; k++) {
                    auto here = vec(set + k * row + c) == most;
                    Vec own = share + (here ? rest : Vec{});
                    rest = here ? Vec{} : rest;
                    if (by_each->at)
                        own += load(by_each->at + seed * by_each->seed + (span.begin + r + k) * by_each->row + c,
                                    width - c);
                    vec(to + (r + k) * row + c) = own;
                }
            }
        }
    };
    pull(whole, by_parameters, *below, [](int64_t) {}, fill);
}

}
