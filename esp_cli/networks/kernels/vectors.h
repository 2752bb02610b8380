// Vectors of the processor at hand, and the products and functions that the kernels are made of.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <utility>

#if defined(__AVX512F__)
constexpr int LANES = 16, VECTORS = 4;
#elif defined(__AVX__)
constexpr int LANES = 8, VECTORS = 2;
#else
constexpr int LANES = 4, VECTORS = 4;
#endif
constexpr int TILE = 6;      // rows of a product whose sums stay in registers, VECTORS of them each
constexpr int64_t PAD = 16;  // widths are filled up with zeros to a multiple of this
constexpr int64_t MOST_PARTS = 16;

typedef float Vec __attribute__((vector_size(LANES * 4), aligned(4), may_alias));
typedef int32_t Ints __attribute__((vector_size(LANES * 4), aligned(4), may_alias));

static Vec &vec(float *at) { return *reinterpret_cast<Vec *>(at); }
static const Vec &vec(const float *at) { return *reinterpret_cast<const Vec *>(at); }

// Read and write fewer numbers than a vector holds; the others are 0.
static inline Vec load(const float *at, int64_t count) {
    if (count >= LANES) return vec(at);
    Vec x = {};
    for (int64_t i = 0; i < count; i++) x[i] = at[i];
    return x;
}
static inline void store(Vec x, float *at, int64_t count) {
    if (count >= LANES) vec(at) = x;
    else
        for (int64_t i = 0; i < count; i++) at[i] = x[i];
}

static int64_t padded(int64_t width) { return (width + PAD - 1) / PAD * PAD; }

struct Free {
    void operator()(float *at) const { std::free(at); }
};
using Scratch = std::unique_ptr<float[], Free>;

static Scratch scratch(int64_t count) {
    return Scratch(static_cast<float *>(std::aligned_alloc(64, static_cast<size_t>(padded(count + 1)) * 4)));
}

struct Span {
    int64_t begin, end;
    int64_t size() const { return end - begin; }
    Span part(int64_t k, int64_t parts) const {
        return {begin + size() * k / parts, begin + size() * (k + 1) / parts};
    }
};

// The rows of S seeds, shared out among threads: a seed's fall into parts that depend on their number alone.
struct Shares {
    int64_t rows, parts, tasks;
    int busy;  // threads with something to do: the others are not woken

    // most: rows of a task, while there are few parts.
    Shares(int64_t seeds, int64_t rows, int64_t most, int64_t threads) : rows(rows), parts(1) {
        while (parts < MOST_PARTS && parts * most < rows && 2 * parts <= rows) parts *= 2;
        tasks = seeds * parts;
        busy = static_cast<int>(std::min(threads, std::max<int64_t>(1, tasks)));
    }
    Span of(int64_t task) const { return Span{0, rows}.part(task % parts, parts); }
    // Go through the rows of a task, block by block: use(seed, rows, whether it is not the first block).
    template <class Use>
    void blocks(int64_t task, int64_t block, Use use) const {
        Span part = of(task);
        int64_t count = (part.size() + block - 1) / block;
        for (int64_t b = 0; b < count; b++) use(task / parts, part.part(b, count), b > 0);
    }
};

// Let threads do something for each seed, work on each task with scratch of their own, whose first `zeros` numbers are
// 0, and do something for each seed again.
template <class Before, class Work, class After>
static void share_out(const Shares &shares, int64_t zeros, int64_t room, Before before, Work work, After after) {
    int64_t seeds = shares.tasks / shares.parts;
#pragma omp parallel num_threads(shares.busy)
    {
#pragma omp for schedule(static)
        for (int64_t s = 0; s < seeds; s++) before(s);
        Scratch own = scratch(zeros + room);
        std::fill(own.get(), own.get() + zeros, 0.0f);
#pragma omp for schedule(static)
        for (int64_t task = 0; task < shares.tasks; task++) work(task, own.get());
#pragma omp for schedule(static)
        for (int64_t s = 0; s < seeds; s++) after(s);
    }
}

// ---- Products

struct Matrix {
    const float *at;
    int64_t row, column;  // steps to the next one
};

// Loops whose numbers have to stay in registers.
#define UNROLLED _Pragma("GCC unroll 12")

template <int M, int N>
static inline void tile(int64_t depth, Matrix a, const float *b, int64_t b_row, const float *bias, bool add, float *c,
                        int64_t c_row) {
    Vec sum[M][N];
    UNROLLED for (int m = 0; m < M; m++)
        UNROLLED for (int n = 0; n < N; n++)
            sum[m][n] = bias ? vec(bias + n * LANES) : add ? vec(c + m * c_row + n * LANES) : Vec{};
    for (int64_t k = 0; k < depth; k++) {
        Vec row[N];
        UNROLLED for (int n = 0; n < N; n++) row[n] = vec(b + k * b_row + n * LANES);
        UNROLLED for (int m = 0; m < M; m++) {
            float factor = a.at[m * a.row + k * a.column];
            UNROLLED for (int n = 0; n < N; n++) sum[m][n] += factor * row[n];
        }
    }
    UNROLLED for (int m = 0; m < M; m++)
        UNROLLED for (int n = 0; n < N; n++) vec(c + m * c_row + n * LANES) = sum[m][n];
}

// Rows of a panel of N vectors, M at a time while there are as many, then fewer.
template <int M, int N>
static void panel(int64_t rows, int64_t depth, Matrix a, const float *b, int64_t b_row, const float *bias, bool add,
                  float *c, int64_t c_row) {
    for (; rows >= M; rows -= M, a.at += M * a.row, c += M * c_row)
        tile<M, N>(depth, a, b, b_row, bias, add, c, c_row);
    if constexpr (M > 1)
        if (rows > 0) panel<M - (M + 2) / 3, N>(rows, depth, a, b, b_row, bias, add, c, c_row);
}

// c [rows, columns] = a b, plus a bias or plus c; columns is a multiple of PAD.
static inline void product(int64_t rows, int64_t columns, int64_t depth, Matrix a, const float *b, int64_t b_row,
                    const float *bias, bool add, float *c, int64_t c_row) {
    int64_t n = 0;
    auto across = [&](auto panel, int64_t width) {
        for (; n + width <= columns; n += width)
            panel(rows, depth, a, b + n, b_row, bias ? bias + n : nullptr, add, c + n, c_row);
    };
    across(panel<TILE, VECTORS>, VECTORS * LANES);
    if (VECTORS > 2) across(panel<2 * TILE, 2>, 2 * LANES);
    across(panel<2 * TILE, 1>, LANES);
}

// Copy a matrix [rows, columns]: row by row where both sides lie so and rows are long, else a few rows at a time, so that
// both go through memory in whole lines.
static inline void copy(int64_t rows, int64_t columns, Matrix from, float *to, int64_t to_row, int64_t to_column) {
    bool in_rows = from.column == 1 && to_column == 1 && columns >= PAD;
    for (int64_t begin = 0; begin < rows; begin += in_rows ? 1 : PAD) {
        int64_t end = std::min(rows, begin + PAD);
        const float *row = from.at + begin * from.row;
        if (in_rows) std::copy(row, row + columns, to + begin * to_row);
        for (int64_t c = 0; !in_rows && c < columns; c++)
            for (int64_t r = begin; r < end; r++)
                to[r * to_row + c * to_column] = from.at[r * from.row + c * from.column];
    }
}

// ---- Functions of many numbers at once

static inline Vec reciprocal(Vec x) {
#if defined(__AVX512F__)
    Vec guess = __builtin_ia32_rcp14ps512_mask(x, Vec{}, 0xFFFF);  // immintrin.h would take a quarter of a second
    return guess * (2.0f - x * guess);
#else
    return 1.0f / x;
#endif
}

// Return exp(x), where |x| is below `most`, and exp(most) or exp(-most) beyond: 2^n exp(r) with |r| <= ln(2) / 2.
static inline Vec exp_of(Vec x, float most = 86.0f) {
    const float round = 12582912.0f;  // 1.5 * 2^23: what is added to it becomes an integer
    x = x > most ? Vec{} + most : x;
    x = x < -most ? Vec{} - most : x;
    Vec n = x * 1.44269504088896341f + round;
    Ints exponent = (Ints)n << 23;
    n -= round;
    Vec r = (x - n * 0.693359375f) + n * 2.12194440e-4f;  // ln(2) in two parts
    Vec e = 1.0f / 5040 * r + 1.0f / 720;
    e = e * r + 1.0f / 120;
    e = e * r + 1.0f / 24;
    e = e * r + 1.0f / 6;
    e = e * r + 0.5f;
    e = e * r + 1.0f;
    e = e * r + 1.0f;
    return (Vec)((Ints)e + exponent);
}

// Return tanh(x) as a quotient of polynomials (Eigen), off by 3e-7 at most; from 7.9 on it is 1 in float32.
static inline Vec tanh_of(Vec x) {
    const float most = 7.90531110763549805f;
    x = x > most ? Vec{} + most : x;
    x = x < -most ? Vec{} - most : x;
    Vec square = x * x;
    Vec p = -2.76076847742355e-16f * square + 2.00018790482477e-13f;
    p = p * square - 8.60467152213735e-11f;
    p = p * square + 5.12229709037114e-08f;
    p = p * square + 1.48572235717979e-05f;
    p = p * square + 6.37261928875436e-04f;
    p = p * square + 4.89352455891786e-03f;
    Vec q = 1.19825839466702e-06f * square + 1.18534705686654e-04f;
    q = q * square + 2.26843463243900e-03f;
    q = q * square + 4.89352518554385e-03f;
    return x * p * reciprocal(q);
}

static inline void activate(float *x, int64_t count, bool tanh) {
    for (int64_t i = 0; i < count; i += LANES) {
        Vec v = vec(x + i);
        vec(x + i) = tanh ? tanh_of(v) : v < 0.0f ? Vec{} : v;
    }
}

// Multiply a gradient by the slope of the activation, read off its output y.
static inline void times_slope(float *gradient, const float *y, int64_t count, bool tanh) {
    for (int64_t i = 0; i < count; i += LANES) {
        Vec g = vec(gradient + i), v = vec(y + i);
        vec(gradient + i) = tanh ? g - g * v * v : v <= 0.0f ? Vec{} : g;
    }
}

// Return log(x) of x > 0: x = 2^n (1 + f) with 1 + f around 1, and a polynomial of f (Cephes).
static inline Vec log_of(Vec x) {
    Ints bits = (Ints)x, exponent = (bits >> 23) - 126;
    Vec f = (Vec)((bits & 0x007FFFFF) | 0x3F000000);  // in [1/2, 1)
    auto small = f < 0.707106781f;
    Vec n = __builtin_convertvector(small ? exponent - 1 : exponent, Vec);
    f = (small ? f + f : f) - 1.0f;
    Vec square = f * f;
    Vec p = 7.0376836292e-2f * f - 1.1514610310e-1f;
    p = p * f + 1.1676998740e-1f;
    p = p * f - 1.2420140846e-1f;
    p = p * f + 1.4249322787e-1f;
    p = p * f - 1.6668057665e-1f;
    p = p * f + 2.0000714765e-1f;
    p = p * f - 2.4999993993e-1f;
    p = p * f + 3.3333331174e-1f;
    return f + (p * f * square - n * 2.12194440e-4f - 0.5f * square) + n * 0.693359375f;
}
