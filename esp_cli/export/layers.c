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
    const int high = (rows - side) / stride + 1, wide = (columns - side) / stride + 1;
    int out, row, column, channel, i, j;
    for (out = 0; out < outputs; out++) {
        for (row = 0; row < high; row++) {
            for (column = 0; column < wide; column++) {
                float sum = bias[out];
                const float *w = weight + out;
                for (channel = 0; channel < channels; channel++) {
                    for (i = 0; i < side; i++) {
                        const float *pixel = x + (channel * rows + row * stride + i) * columns + column * stride;
                        for (j = 0; j < side; j++, w += outputs) sum += pixel[j] * *w;
                    }
                }
                y[(out * high + row) * wide + column] = sum;
            }
        }
    }
}

static void global_max_pool(int channels, int places, const float *x, float *y)
{
    int channel, place;
    for (channel = 0; channel < channels; channel++) {
        y[channel] = x[channel * places];
        for (place = 1; place < places; place++) {
            const float next = x[channel * places + place];
            if (next > y[channel] || next != next) y[channel] = next; /* NaN stays */
        }
    }
}

static void aggregate(const float *ways, int width, float reach_squared, float reach, const float *x, float *y)
{
    int i, j, k;
    for (i = 0; i < AGENTS; i++, ways += ESP_POLICY_OBSERVATION) {
        float *own = y + i * ROW, *way = own + width, *received = way + 2, count = 1.0f;
        memcpy(own, x + i * ROW, sizeof(float) * width);
        for (k = 0; k < width + 2; k++) way[k] = 0.0f;
        for (j = 0; j < AGENTS; j++) {
            const float *to = ways + 2 * (j < i ? j : j - 1);
            if (j == i || !(to[0] * to[0] + to[1] * to[1] < reach_squared)) continue;
            count += 1.0f;
            for (k = 0; k < 2; k++) way[k] += to[k];
            for (k = 0; k < width; k++) received[k] += x[j * ROW + k];
        }
        for (k = 0; k < 2; k++) way[k] /= count * reach;
        for (k = 0; k < width; k++) received[k] /= count;
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
