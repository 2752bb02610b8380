static void affine(const float *weight, const float *bias, int inputs, int outputs,
                   const float *x, float *y)
{
    int i, j;
    for (j = 0; j < outputs; j++) y[j] = bias[j];
    for (i = 0; i < inputs; i++) {
        for (j = 0; j < outputs; j++) y[j] += x[i] * weight[i * outputs + j];
    }
}

static void apply_relu(float *x, int width)
{
    int k;
    for (k = 0; k < width; k++) x[k] = x[k] < 0.0f ? 0.0f : x[k]; /* NaN stays */
}

static void apply_tanh(float *x, int width)
{
    int k;
    for (k = 0; k < width; k++) x[k] = tanhf(x[k]);
}

static void normalise(const float *weight, const float *bias, int width, float *x)
{
    int k;
    float mean = 0.0f, variance = 0.0f, scale;
    for (k = 0; k < width; k++) mean += x[k];
    mean /= (float)width;
    for (k = 0; k < width; k++) variance += (x[k] - mean) * (x[k] - mean);
    scale = 1.0f / sqrtf(variance / (float)width + 1e-05f);
    for (k = 0; k < width; k++) x[k] = (x[k] - mean) * scale * weight[k] + bias[k];
}

static void convolve(const float *weight, const float *bias, int channels, int rows, int columns,
                     int side, int stride, int outputs, const float *x, float *y)
{
    const int wide = (columns - side) / stride + 1, places = ((rows - side) / stride + 1) * wide;
    int place, out, i, j;
    for (place = 0; place < places; place++) {
        const float *corner = x + (place / wide * columns + place % wide) * stride;
        for (out = 0; out < outputs; out++) {
            float *sum = y + out * places + place;
            *sum = bias[out];
            for (i = 0; i < channels * side; i++) {
                const float *pixels = corner + (i / side * rows + i % side) * columns;
                for (j = 0; j < side; j++) *sum += pixels[j] * weight[(i * side + j) * outputs + out];
            }
        }
    }
}

static void global_max_pool(int channels, int places, const float *x, float *y)
{
    int k;
    for (k = 0; k < channels * places; k++) {
        float *most = y + k / places;
        if (k % places == 0 || x[k] > *most || x[k] != x[k]) *most = x[k]; /* NaN stays */
    }
}

static void aggregate(const float *ways, int width, float reach_squared, const float *x, float *y)
{
    int i, j, k;
    for (i = 0; i < AGENTS; i++, ways += ESP_POLICY_OBSERVATION) {
        float *way = y + i * ROW + width, *received = way + 2, count = 1.0f;
        memcpy(y + i * ROW, x + i * ROW, sizeof(float) * width);
        for (k = 0; k < width + 2; k++) way[k] = 0.0f;
        for (j = 0; j < AGENTS; j++) {
            const float *to = ways + 2 * (j < i ? j : j - 1);
            if (j == i || !(to[0] * to[0] + to[1] * to[1] < reach_squared)) continue;
            count += 1.0f;
            for (k = 0; k < 2; k++) way[k] += to[k] / sqrtf(reach_squared);
            for (k = 0; k < width; k++) received[k] += x[j * ROW + k];
        }
        for (k = 0; k < width + 2; k++) way[k] /= count;
    }
}

static float apart(const float *a, const float *b)
{
    return (a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]);
}

static float farthest(const float *places, int count, int width, const float *from, float most)
{
    int j;
    for (j = 0; j < count; j++) most = fmaxf(most, apart(places + j * width, from));
    return most;
}

/* The square of the distance to the nearest other place; `none` where there is no other. */
static float nearest(const float *at, const float *places, int count, int width, float none)
{
    int j, found = 0;
    for (j = 0; j < count; j++) {
        const float *place = places + j * width;
        const float square = apart(at, place);
        if (place != at && (!found || square < none)) none = square, found = 1;
    }
    return none;
}

/* Copies the `near` things with the nearest places, and returns how many they are. */
static int nearest_things(const float *things, int count, int width, int place, const float *from, int near,
                          float *to)
{
    int i, j, copied = 0;
    for (i = 0; i < count; i++) {
        const float mine = apart(things + i * width + place, from);
        int before = 0;
        for (j = 0; j < count && before < near; j++) {
            const float square = apart(things + j * width + place, from);
            before += square < mine || (square == mine && j < i);
        }
        if (before < near && copied < near) memcpy(to + width * copied++, things + i * width, sizeof(float) * width);
    }
    return copied;
}

/* Adds the features of the i-th of `count` things to their mean, and takes the maximum behind it. */
static void pool(int features, int i, int count, const float *x, float *y)
{
    int k;
    for (k = 0; k < features; k++) {
        y[k] = (i ? y[k] : 0.0f) + x[k] / (float)count;
        y[features + k] = i && !(x[k] > y[features + k]) ? y[features + k] : x[k];
    }
}

static float sigmoid(float x)
{
    return 0.5f + 0.5f * tanhf(0.5f * x);
}

static void recur(int width, const float *into, const float *back, float *hidden)
{
    int k;
    for (k = 0; k < width; k++) {
        const float reset = sigmoid(into[k] + back[k]);
        const float update = sigmoid(into[width + k] + back[width + k]);
        const float candidate = tanhf(into[2 * width + k] + reset * back[2 * width + k]);
        hidden[k] = candidate + update * (hidden[k] - candidate);
    }
}

/* Brings numbers into their bounds together: u tanh|u| / |u|. */
static void squash(const float *x, int width, float *action)
{
    int k;
    float square = 0.0f, length;
    for (k = 0; k < width; k++) square += x[k] * x[k];
    length = sqrtf(square + 1e-18f);
    for (k = 0; k < width; k++) action[k] = x[k] * (tanhf(length) / length);
}

static int choose(const float *x)
{
    int k, best = 0;
    for (k = 1; k < ESP_POLICY_ACTION; k++) {
        if (x[k] > x[best]) best = k;
    }
    return best;
}

/* Where nothing is allowed, everything is. */
static int choose_allowed(const float *x, const unsigned char *allowed)
{
    int k, best = -1, any = 0;
    for (k = 0; k < ESP_POLICY_ACTION; k++) any |= allowed[k];
    for (k = 0; k < ESP_POLICY_ACTION; k++) {
        if ((allowed[k] || !any) && (best < 0 || x[k] > x[best])) best = k;
    }
    return best;
}
