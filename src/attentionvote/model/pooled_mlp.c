/* The arithmetic of a set abstraction on a CPU: shared MLP over the neighbours of a centre, then the maximum.
 *
 * Everything of one centre stays in the first-level cache; the backward pass recomputes the hidden layers. Neighbours
 * that only repeat earlier ones (a ball with fewer points than places) are left out, and in the backward pass all that
 * are no channel's maximum: they get no gradient. Called through ctypes by model/pooled_mlp.py, whose reference
 * formulation is the oracle of the tests. Weights of layer l: forward takes them as (in, out) rows, backward also as
 * (out, in). All widths are multiples of 8. Where the processor has AVX-512, whole tiles are of 16 numbers; every
 * number stays the same sum in the same order.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef float v8 __attribute__((vector_size(32), aligned(4)));
#define V(p) (*(v8 *)(p))
#define C(p) (*(const v8 *)(p))

typedef int32_t i8 __attribute__((vector_size(32)));

static v8 relu_of(v8 s) { return (v8)((s > (v8){0}) & (i8)s); }

#ifdef __AVX512F__
typedef float v16 __attribute__((vector_size(64), aligned(4)));
typedef int32_t i16 __attribute__((vector_size(64)));
#define WIDE_ROWS 8
#define WIDE_COLUMNS 32
#define INLINE static inline __attribute__((always_inline))

/* `height` rows (a constant) and 32 columns of linear. */
INLINE void linear_tile(const float *x, int n_in, const float *w, const float *bias, int n_out, float *y, int relu,
                        const int height) {
    v16 a[WIDE_ROWS], b[WIDE_ROWS];
    for (int j = 0; j < height; j++) a[j] = *(const v16 *)bias, b[j] = *(const v16 *)(bias + 16);
    for (int i = 0; i < n_in; i++, w += n_out) {
        const v16 w0 = *(const v16 *)w, w1 = *(const v16 *)(w + 16);
        for (int j = 0; j < height; j++) {
            const float v = x[(int64_t)j * n_in + i];
            a[j] += v * w0, b[j] += v * w1;
        }
    }
    for (int j = 0; j < height; j++, y += n_out) {
        if (relu) a[j] = (v16)((a[j] > (v16){0}) & (i16)a[j]), b[j] = (v16)((b[j] > (v16){0}) & (i16)b[j]);
        *(v16 *)y = a[j], *(v16 *)(y + 16) = b[j];
    }
}

/* linear for a multiple of 4 rows and of 32 columns. */
static void linear_wide(const float *in, int rows, int n_in, const float *weights, const float *bias, int n_out,
                        float *out, int relu) {
    for (int o = 0; o < n_out; o += WIDE_COLUMNS) {
        int r = 0;
        for (; r + 8 <= rows; r += 8)
            linear_tile(in + (int64_t)r * n_in, n_in, weights + o, bias + o, n_out, out + (int64_t)r * n_out + o, relu, 8);
        if (r < rows)
            linear_tile(in + (int64_t)r * n_in, n_in, weights + o, bias + o, n_out, out + (int64_t)r * n_out + o, relu, 4);
    }
}

/* `height` rows (a constant) and 32 columns of outer_wide. */
INLINE void outer_tile(const float *x, int n_left, const float *w, int n_right, int rows, float *sums, const int height) {
    v16 a[WIDE_ROWS], b[WIDE_ROWS];
    for (int j = 0; j < height; j++)
        a[j] = *(const v16 *)(sums + (int64_t)j * n_right), b[j] = *(const v16 *)(sums + (int64_t)j * n_right + 16);
    for (int r = 0; r < rows; r++, x += n_left, w += n_right) {
        const v16 w0 = *(const v16 *)w, w1 = *(const v16 *)(w + 16);
        for (int j = 0; j < height; j++) a[j] += x[j] * w0, b[j] += x[j] * w1;
    }
    for (int j = 0; j < height; j++)
        *(v16 *)(sums + (int64_t)j * n_right) = a[j], *(v16 *)(sums + (int64_t)j * n_right + 16) = b[j];
}

/* sums[n_left][n_right] += transpose(left[rows][n_left]) * right[rows][n_right], n_right a multiple of 32. */
static void outer_wide(const float *left, int n_left, const float *right, int n_right, int rows, float *sums) {
    for (int o = 0; o < n_right; o += WIDE_COLUMNS) {
        int i = 0;
        for (; i + 8 <= n_left; i += 8)
            outer_tile(left + i, n_left, right + o, n_right, rows, sums + (int64_t)i * n_right + o, 8);
        for (; i + 2 <= n_left; i += 2)
            outer_tile(left + i, n_left, right + o, n_right, rows, sums + (int64_t)i * n_right + o, 2);
        if (i < n_left) outer_tile(left + i, n_left, right + o, n_right, rows, sums + (int64_t)i * n_right + o, 1);
    }
}
#endif

/* out[rows][n_out] = in[rows][n_in] * weights[n_in][n_out] + bias, optionally ReLU. */
static void linear(const float *in, int rows, int n_in, const float *weights, const float *bias, int n_out, float *out,
                   int relu) {
#ifdef __AVX512F__
    if (rows % 4 == 0 && n_out % WIDE_COLUMNS == 0) {
        linear_wide(in, rows, n_in, weights, bias, n_out, out, relu);
        return;
    }
#endif
    const v8 zero = {0};
    for (int o = 0; o < n_out; o += 16) {
        const int wide = o + 8 < n_out;
        for (int r = 0; r < rows; r += 4) {
            const int left = rows - r;
            const float *x0 = in + (int64_t)r * n_in, *x1 = left > 1 ? x0 + n_in : x0;
            const float *x2 = left > 2 ? x0 + 2 * n_in : x0, *x3 = left > 3 ? x0 + 3 * n_in : x0;
            const v8 b0 = C(bias + o), b1 = wide ? C(bias + o + 8) : zero;
            v8 a00 = b0, a01 = b1, a10 = b0, a11 = b1, a20 = b0, a21 = b1, a30 = b0, a31 = b1;
            const float *w = weights + o;
            if (wide)
                for (int i = 0; i < n_in; i++, w += n_out) {
                    const v8 w0 = C(w), w1 = C(w + 8);
                    a00 += x0[i] * w0, a01 += x0[i] * w1, a10 += x1[i] * w0, a11 += x1[i] * w1;
                    a20 += x2[i] * w0, a21 += x2[i] * w1, a30 += x3[i] * w0, a31 += x3[i] * w1;
                }
            else
                for (int i = 0; i < n_in; i++, w += n_out) {
                    const v8 w0 = C(w);
                    a00 += x0[i] * w0, a10 += x1[i] * w0, a20 += x2[i] * w0, a30 += x3[i] * w0;
                }
            float *y = out + (int64_t)r * n_out + o;
            if (relu)
                a00 = relu_of(a00), a01 = relu_of(a01), a10 = relu_of(a10), a11 = relu_of(a11), a20 = relu_of(a20),
                a21 = relu_of(a21), a30 = relu_of(a30), a31 = relu_of(a31);
            V(y) = a00;
            if (left > 1) V(y + n_out) = a10;
            if (left > 2) V(y + 2 * n_out) = a20;
            if (left > 3) V(y + 3 * n_out) = a30;
            if (!wide) continue;
            V(y + 8) = a01;
            if (left > 1) V(y + n_out + 8) = a11;
            if (left > 2) V(y + 2 * n_out + 8) = a21;
            if (left > 3) V(y + 3 * n_out + 8) = a31;
        }
    }
}

static void axpy(float a, const float *x, float *y, int n) {
#ifdef __AVX512F__
    if (n % 16 == 0) {
        for (int i = 0; i < n; i += 16) *(v16 *)(y + i) += a * *(const v16 *)(x + i);
        return;
    }
#endif
    for (int i = 0; i < n; i += 8) V(y + i) += a * C(x + i);
}

/* sums[n_left][n_right] += transpose(left[rows][n_left]) * right[rows][n_right]. */
static void outer(const float *left, int n_left, const float *right, int n_right, int rows, float *sums) {
#ifdef __AVX512F__
    if (n_right % WIDE_COLUMNS == 0) {
        outer_wide(left, n_left, right, n_right, rows, sums);
        return;
    }
#endif
    for (int r = 0; r < rows; r++, left += n_left, right += n_right)
        for (int i = 0; i < n_left; i++)
            if (left[i] != 0.0f) axpy(left[i], right, sums + (int64_t)i * n_right, n_right);
}

/* Gradients behind a ReLU, which are added to the bias's. */
static void gated(float *gradients, const float *hidden, int rows, int width, float *grad_bias) {
    for (int i = 0; i < width; i += 8) {
        v8 sum = C(grad_bias + i);
        for (int64_t at = i; at < (int64_t)rows * width; at += width) {
            const v8 g = (v8)((C(hidden + at) > (v8){0}) & (i8)C(gradients + at));
            V(gradients + at) = g, sum += g;
        }
        V(grad_bias + i) = sum;
    }
}

/* How many neighbours have to be looked at: those from h on repeat the first h in turn, or the first one. A few more,
 * if there are any, so that they fill tiles. */
static int different(const float *geometry, int k, int channels, const int64_t *index) {
    const size_t size = sizeof(float) * (size_t)channels;
    int h = 0;
    for (int j = 1; j < k; j++) {
        const float *row = geometry + (int64_t)j * channels;
        const int first = (!index || index[j] == index[0]) && memcmp(row, geometry, size) == 0;
        if (!h && first) h = j;
        else if (h && !first && !((!index || index[j] == index[j - h]) && memcmp(row, row - (int64_t)h * channels, size) == 0))
            return k;
    }
    const int rows = (h + 3) / 4 * 4;
    return h && rows < k ? rows : k;
}

/* Hidden layers of one centre: hidden[l] for l < layers - 1. The first adds the projected features of the level below. */
static void hidden_layers(const float *geometry, int k, int channels, const float *projected, const int64_t *index,
                          int layers, const int32_t *widths, const float *const *weights, const float *const *biases,
                          float *const *hidden) {
    linear(geometry, k, channels, weights[0], biases[0], widths[0], hidden[0], projected == NULL);
    if (projected)
        for (int j = 0; j < k; j++) {
            const float *u = projected + index[j] * widths[0];
            float *h = hidden[0] + (int64_t)j * widths[0];
            for (int i = 0; i < widths[0]; i += 8) V(h + i) = relu_of(C(h + i) + C(u + i));
        }
    for (int l = 1; l < layers - 1; l++)
        linear(hidden[l - 1], k, widths[l - 1], weights[l], biases[l], widths[l], hidden[l], 1);
}

/* out[c][width] = max over neighbours, winner[c][width] = which neighbour. */
int pooled_forward(const float *geometry, int64_t from, int64_t to, int32_t k, int32_t channels, const float *projected,
                   const int64_t *index, int32_t layers, const int32_t *widths, const float *const *weights,
                   const float *const *biases, float *out, uint8_t *winner) {
    float *hidden[8], *last;
    const int top = widths[layers - 1];
    size_t total = (size_t)k * top;
    for (int l = 0; l < layers - 1; l++) total += (size_t)k * widths[l];
    float *memory = malloc(sizeof(float) * total);
    if (!memory) return 1;
    last = memory;
    float *next = memory + (size_t)k * top;
    for (int l = 0; l < layers - 1; next += (size_t)k * widths[l], l++) hidden[l] = next;
    for (int64_t c = from; c < to; c++) {
        const float *g = geometry + c * k * channels;
        const int64_t *at = projected ? index + c * k : NULL;
        const int rows = different(g, k, channels, at);
        hidden_layers(g, rows, channels, projected, at, layers, widths, weights, biases, hidden);
        linear(hidden[layers - 2], rows, widths[layers - 2], weights[layers - 1], biases[layers - 1], top, last, 0);
        float *o = out + c * top;
        uint8_t *win = winner + c * top;
        memcpy(o, last, sizeof(float) * top);
        memset(win, 0, top);
        for (int j = 1; j < rows; j++) {
            const float *row = last + (int64_t)j * top;
            for (int i = 0; i < top; i++) {
                win[i] = row[i] > o[i] ? (uint8_t)j : win[i];
                o[i] = row[i] > o[i] ? row[i] : o[i];
            }
        }
    }
    free(memory);
    return 0;
}

/* Adds to grad_weights[l] (out, in), grad_biases[l] and grad_projected; transposed[l] is (out, in). */
int pooled_backward(const float *geometry, int64_t from, int64_t to, int32_t k, int32_t channels, const float *projected,
                    const int64_t *index, int32_t layers, const int32_t *widths, const float *const *weights,
                    const float *const *biases, const float *const *transposed, const uint8_t *winner,
                    const float *grad_out, float *const *grad_weights, float *const *grad_biases,
                    float *grad_projected) {
    float *hidden[8], *grads[8];
    const int top = widths[layers - 1], n = layers - 1, room = (k + 3) / 4 * 4;
    size_t total = (size_t)room * channels, widest = 0;
    for (int l = 0; l < n; l++) {
        total += 2 * (size_t)room * widths[l];
        widest = (size_t)widths[l] > widest ? (size_t)widths[l] : widest;
    }
    float *memory = malloc(sizeof(float) * total), *none = calloc(widest, sizeof(float)); /* no bias */
    int64_t *source = malloc(sizeof(int64_t) * room);
    int *place = malloc(sizeof(int) * k);
    if (!memory || !none || !source || !place) {
        free(memory), free(none), free(source), free(place);
        return 1;
    }
    float *packed = memory, *next = memory + (size_t)room * channels;
    for (int l = 0; l < n; next += 2 * (size_t)room * widths[l], l++)
        hidden[l] = next, grads[l] = next + (size_t)room * widths[l];
    for (int64_t c = from; c < to; c++) {
        const float *g = geometry + c * k * channels, *grad = grad_out + c * top;
        const uint8_t *win = winner + c * top;
        const int under_top = widths[n - 1];
        /* The neighbours that get a gradient, in their order, and as many without one as fill the last tile. */
        memset(place, 0, sizeof(int) * k);
        for (int i = 0; i < top; i++) place[win[i]] |= grad[i] != 0.0f;
        int rows = 0;
        for (int j = 0; j < k; j++) {
            if (!place[j]) continue;
            memcpy(packed + (int64_t)rows * channels, g + (int64_t)j * channels, sizeof(float) * channels);
            source[rows] = projected ? index[c * k + j] : 0;
            place[j] = rows++;
        }
        if (rows == 0) continue;
        const int touched = rows;
        for (; rows % 4; rows++) {
            memcpy(packed + (int64_t)rows * channels, packed, sizeof(float) * channels);
            source[rows] = source[0];
        }
        hidden_layers(packed, rows, channels, projected, source, layers, widths, weights, biases, hidden);
        memset(grads[n - 1], 0, sizeof(float) * (size_t)rows * under_top);
        for (int i = 0; i < top; i++) {
            if (grad[i] == 0.0f) continue;
            const int64_t w = place[win[i]] * under_top;
            axpy(grad[i], hidden[n - 1] + w, grad_weights[n] + (int64_t)i * under_top, under_top);
            axpy(grad[i], transposed[n] + (int64_t)i * under_top, grads[n - 1] + w, under_top);
            grad_biases[n][i] += grad[i];
        }
        for (int l = n - 1; l >= 0; l--) {
            const int width = widths[l], under = l ? widths[l - 1] : channels;
            gated(grads[l], hidden[l], rows, width, grad_biases[l]);
            /* The first layer's gradient is kept as (in, out): its input is narrower than a vector. */
            if (l == 0) outer(packed, under, grads[0], width, rows, grad_weights[0]);
            else {
                outer(grads[l], width, hidden[l - 1], under, rows, grad_weights[l]);
                linear(grads[l], rows, width, transposed[l], none, under, grads[l - 1], 0);
            }
        }
        for (int j = 0; grad_projected && j < touched; j++)
            axpy(1.0f, grads[0] + (int64_t)j * widths[0], grad_projected + source[j] * widths[0], widths[0]);
    }
    free(memory), free(none), free(source), free(place);
    return 0;
}
