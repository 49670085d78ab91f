/* The arithmetic of a set abstraction on a CPU: shared MLP over the neighbours of a centre, then the maximum.
 *
 * Everything of one centre stays in the first-level cache; the backward pass recomputes the hidden layers and uses
 * that the maximum hands its gradient to one neighbour a channel, so the widest layer costs almost nothing there.
 * Called through ctypes by model/pooled_mlp.py, whose reference formulation is the oracle of the tests. Weights of
 * layer l: forward takes them as (in, out) rows, backward also as (out, in). All widths are multiples of 8. Where the
 * processor has AVX-512, whole tiles are of 16 numbers; every number stays the same sum in the same order.
 */
#include <math.h>
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

/* linear for whole tiles of 8 rows and 32 columns; every number is the same sum in the same order. */
static void linear_wide(const float *in, int rows, int n_in, const float *weights, const float *bias, int n_out,
                        float *out, int relu) {
    for (int o = 0; o < n_out; o += WIDE_COLUMNS)
        for (int r = 0; r < rows; r += WIDE_ROWS) {
            const float *x = in + (int64_t)r * n_in, *w = weights + o;
            v16 a[WIDE_ROWS], b[WIDE_ROWS];
            for (int j = 0; j < WIDE_ROWS; j++)
                a[j] = *(const v16 *)(bias + o), b[j] = *(const v16 *)(bias + o + 16);
            for (int i = 0; i < n_in; i++, w += n_out) {
                const v16 w0 = *(const v16 *)w, w1 = *(const v16 *)(w + 16);
                for (int j = 0; j < WIDE_ROWS; j++) {
                    const float v = x[(int64_t)j * n_in + i];
                    a[j] += v * w0, b[j] += v * w1;
                }
            }
            float *y = out + (int64_t)r * n_out + o;
            for (int j = 0; j < WIDE_ROWS; j++, y += n_out) {
                if (relu) a[j] = (v16)((a[j] > (v16){0}) & (i16)a[j]), b[j] = (v16)((b[j] > (v16){0}) & (i16)b[j]);
                *(v16 *)y = a[j], *(v16 *)(y + 16) = b[j];
            }
        }
}

/* sums[n_left][n_right] += transpose(left[rows][n_left]) * right[rows][n_right], in tiles as above. */
static void outer_wide(const float *left, int n_left, const float *right, int n_right, int rows, float *sums) {
    for (int i = 0; i < n_left; i += WIDE_ROWS)
        for (int o = 0; o < n_right; o += WIDE_COLUMNS) {
            v16 a[WIDE_ROWS], b[WIDE_ROWS];
            float *y = sums + (int64_t)i * n_right + o;
            for (int j = 0; j < WIDE_ROWS; j++)
                a[j] = *(const v16 *)(y + (int64_t)j * n_right), b[j] = *(const v16 *)(y + (int64_t)j * n_right + 16);
            for (int r = 0; r < rows; r++) {
                const float *x = left + (int64_t)r * n_left + i, *w = right + (int64_t)r * n_right + o;
                const v16 w0 = *(const v16 *)w, w1 = *(const v16 *)(w + 16);
                for (int j = 0; j < WIDE_ROWS; j++) a[j] += x[j] * w0, b[j] += x[j] * w1;
            }
            for (int j = 0; j < WIDE_ROWS; j++)
                *(v16 *)(y + (int64_t)j * n_right) = a[j], *(v16 *)(y + (int64_t)j * n_right + 16) = b[j];
        }
}
#endif

/* out[rows][n_out] = in[rows][n_in] * weights[n_in][n_out] + bias, optionally ReLU. */
static void linear(const float *in, int rows, int n_in, const float *weights, const float *bias, int n_out, float *out,
                   int relu) {
#ifdef __AVX512F__
    if (rows % WIDE_ROWS == 0 && n_out % WIDE_COLUMNS == 0) {
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

/* A gradient behind a ReLU, which is added to the bias's. */
static void gated(float *gradient, const float *hidden, int n, float *grad_bias) {
    for (int i = 0; i < n; i++) gradient[i] = hidden[i] > 0.0f ? gradient[i] : 0.0f;
    for (int i = 0; i < n; i += 8) V(grad_bias + i) += C(gradient + i);
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
        hidden_layers(geometry + c * k * channels, k, channels, projected, index ? index + c * k : NULL, layers, widths,
                      weights, biases, hidden);
        linear(hidden[layers - 2], k, widths[layers - 2], weights[layers - 1], biases[layers - 1], top, last, 0);
        float *o = out + c * top;
        uint8_t *win = winner + c * top;
        memcpy(o, last, sizeof(float) * top);
        memset(win, 0, top);
        for (int j = 1; j < k; j++) {
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
    const int top = widths[layers - 1], n = layers - 1;
    size_t total = 0, widest = 0;
    for (int l = 0; l < n; l++) {
        total += 2 * (size_t)k * widths[l];
        widest = (size_t)widths[l] > widest ? (size_t)widths[l] : widest;
    }
    float *memory = malloc(sizeof(float) * total), *none = calloc(widest, sizeof(float)); /* no bias */
    uint8_t *touched = malloc((size_t)k);
    if (!memory || !touched || !none) {
        free(memory), free(touched), free(none);
        return 1;
    }
    float *next = memory;
    for (int l = 0; l < n; next += 2 * (size_t)k * widths[l], l++)
        hidden[l] = next, grads[l] = next + (size_t)k * widths[l];
    for (int64_t c = from; c < to; c++) {
        const float *g = geometry + c * k * channels, *grad = grad_out + c * top;
        const uint8_t *win = winner + c * top;
        hidden_layers(g, k, channels, projected, index ? index + c * k : NULL, layers, widths, weights, biases, hidden);
        memset(touched, 0, (size_t)k);
        memset(grads[n - 1], 0, sizeof(float) * (size_t)k * widths[n - 1]);
        for (int i = 0; i < top; i++) {
            const int64_t w = win[i];
            if (grad[i] == 0.0f) continue;
            touched[w] = 1;
            axpy(grad[i], hidden[n - 1] + w * widths[n - 1], grad_weights[n] + (int64_t)i * widths[n - 1], widths[n - 1]);
            axpy(grad[i], transposed[n] + (int64_t)i * widths[n - 1], grads[n - 1] + w * widths[n - 1], widths[n - 1]);
            grad_biases[n][i] += grad[i];
        }
        int first = n - 1; /* the highest layer whose gradients still have to be handed down */
#ifdef __AVX512F__
        /* All neighbours together; the untouched ones' gradients are zero. */
        for (; first > 0 && k % WIDE_ROWS == 0 && widths[first - 1] % WIDE_COLUMNS == 0; first--) {
            const int width = widths[first], under = widths[first - 1];
            for (int64_t j = 0; j < k; j++)
                gated(grads[first] + j * width, hidden[first] + j * width, width, grad_biases[first]);
            outer_wide(grads[first], width, hidden[first - 1], under, k, grad_weights[first]);
            linear_wide(grads[first], k, width, transposed[first], none, under, grads[first - 1], 0);
        }
#endif
        for (int j = 0; j < k; j++) {
            if (!touched[j]) continue;
            for (int l = first; l >= 0; l--) {
                const int width = widths[l];
                float *gh = grads[l] + (int64_t)j * width;
                gated(gh, hidden[l] + (int64_t)j * width, width, grad_biases[l]);
                if (l == 0) break;
                const float *below = hidden[l - 1] + (int64_t)j * widths[l - 1];
                float *gb = grads[l - 1] + (int64_t)j * widths[l - 1];
                memset(gb, 0, sizeof(float) * widths[l - 1]);
                for (int i = 0; i < width; i++) {
                    if (gh[i] == 0.0f) continue;
                    axpy(gh[i], below, grad_weights[l] + (int64_t)i * widths[l - 1], widths[l - 1]);
                    axpy(gh[i], transposed[l] + (int64_t)i * widths[l - 1], gb, widths[l - 1]);
                }
            }
            const float *gh = grads[0] + (int64_t)j * widths[0];
            if (grad_projected) axpy(1.0f, gh, grad_projected + index[c * k + j] * widths[0], widths[0]);
            /* The first layer's gradient is kept as (in, out): its input is narrower than a vector. */
            for (int i = 0; i < channels; i++) axpy(g[(int64_t)j * channels + i], gh, grad_weights[0] + (int64_t)i * widths[0], widths[0]);
        }
    }
    free(memory), free(touched), free(none);
    return 0;
}
