/* The small functions of the network on a CPU: what a centre is told about its neighbours, features between centres,
 * the points in a part's box, the votes around a seed, and the heatmap of the votes.
 *
 * Called through ctypes by model/point_features.py, interpolation.py, refinement.py and proposals.py, whose reference
 * formulations are the oracles of the tests. Numbers that belong together are laid out one kind after the other, so that the compiler
 * computes as many at once as the processor can. Each works on rows from..to, so that threads can share them.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define CHUNK 64

/* Ten channels of every neighbour: offset / radius (3), its normal (3), distance / radius, and the three cosines of
 * the point pair feature. An index is within its sample: sample s of a level owns rows s * stride of points. */
int pair_features(const float *points, const float *normals, const float *centers, const float *center_normals,
                  const int64_t *index, int64_t from, int64_t to, int32_t k, float radius, float *out) {
    const float inverse = 1.0f / radius;
    for (int64_t c = from; c < to; c++) {
        const float *p = centers + 3 * c, *m = center_normals + 3 * c;
        for (int j = 0; j < k; j++) {
            const int64_t i = index[c * k + j];
            const float *q = points + 3 * i, *n = normals + 3 * i;
            const float x = q[0] - p[0], y = q[1] - p[1], z = q[2] - p[2];
            const float length = sqrtf(x * x + y * y + z * z), s = 1.0f / (length + 1e-6f);
            float *o = out + (c * k + j) * 10;
            o[0] = x * inverse, o[1] = y * inverse, o[2] = z * inverse;
            o[3] = n[0], o[4] = n[1], o[5] = n[2];
            o[6] = length * inverse;
            o[7] = (m[0] * x + m[1] * y + m[2] * z) * s;
            o[8] = (n[0] * x + n[1] * y + n[2] * z) * s;
            o[9] = m[0] * n[0] + m[1] * n[1] + m[2] * n[2];
        }
    }
    return 0;
}

/* Samples from..to: out[fine][width + own] of every fine point, the weighted sum of the features of its three nearest
 * coarse ones and its own features behind it. An index is within its sample. */
int interpolate(const float *coarse, const float *fine, const int64_t *nearest, const float *weights, int64_t from,
                int64_t to, int32_t below, int32_t rows, int32_t width, int32_t own, float *out) {
    for (int64_t r = from * rows; r < to * rows; r++) {
        const float *features = coarse + r / rows * below * width, *w = weights + 3 * r;
        const float *a = features + nearest[3 * r] * width, *b = features + nearest[3 * r + 1] * width;
        const float *c = features + nearest[3 * r + 2] * width;
        float *o = out + r * (width + own);
        for (int32_t i = 0; i < width; i++) o[i] = a[i] * w[0] + b[i] * w[1] + c[i] * w[2];
        memcpy(o + width, fine + r * own, sizeof(float) * own);
    }
    return 0;
}

/* The gradients of both inputs, given that of `out`. */
int interpolate_backward(const float *grad, const int64_t *nearest, const float *weights, int64_t from, int64_t to,
                         int32_t below, int32_t rows, int32_t width, int32_t own, float *grad_coarse, float *grad_fine) {
    memset(grad_coarse + from * below * width, 0, sizeof(float) * (size_t)((to - from) * below * width));
    for (int64_t r = from * rows; r < to * rows; r++) {
        const float *g = grad + r * (width + own);
        for (int k = 0; k < 3; k++) {
            float *sum = grad_coarse + (r / rows * below + nearest[3 * r + k]) * width;
            const float w = weights[3 * r + k];
            for (int32_t i = 0; i < width; i++) sum[i] += w * g[i];
        }
        memcpy(grad_fine + r * own, g + width, sizeof(float) * own);
    }
    return 0;
}

/* The first `count` points in index order that lie in a part's box (low..high, part frame) when the part is at pose q,
 * with their normals, in the part frame and in units of `scale`: out[q][count][6]. Fewer are repeated in turn; none
 * gives zeros. Rows of one sample that follow each other share its points laid out by axis. */
int points_in_box(const float *points, const float *normals, int32_t n, const int64_t *sample, const float *center,
                  const float *rotation, int64_t from, int64_t to, const float *low, const float *high, float scale,
                  int32_t count, float *out) {
    float *x = malloc(sizeof(float) * 3 * (size_t)n), *y = x + n, *z = y + n;
    if (!x) return 1;
    int64_t held = -1;
    for (int64_t q = from; q < to; q++) {
        const float *p = points + 3 * n * sample[q], *m = normals + 3 * n * sample[q];
        const float *c = center + 3 * q, *r = rotation + 9 * q;
        float *o = out + q * count * 6;
        if (held != sample[q])
            for (int32_t i = 0; i < n; i++) x[i] = p[3 * i], y[i] = p[3 * i + 1], z[i] = p[3 * i + 2];
        held = sample[q];
        int32_t have = 0;
        for (int32_t start = 0; start < n && have < count; start += CHUNK) {
            const int32_t here = n - start < CHUNK ? n - start : CHUNK;
            uint8_t inside[CHUNK] = {0};
            for (int32_t i = 0; i < here; i++) {
                const float dx = x[start + i] - c[0], dy = y[start + i] - c[1], dz = z[start + i] - c[2];
                const float u = r[0] * dx + r[3] * dy + r[6] * dz;
                const float v = r[1] * dx + r[4] * dy + r[7] * dz;
                const float w = r[2] * dx + r[5] * dy + r[8] * dz;
                inside[i] = (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1]) & (w >= low[2]) & (w <= high[2]);
            }
            for (int32_t i = 0; i < here && have < count; i++) {
                uint64_t eight;
                if (i % 8 == 0 && (memcpy(&eight, inside + i, 8), eight == 0)) i += 7;
                else if (inside[i]) {
                    const float *t = p + 3 * (start + i), *s = m + 3 * (start + i);
                    const float d[3] = {t[0] - c[0], t[1] - c[1], t[2] - c[2]};
                    float *e = o + 6 * have++;
                    for (int a = 0; a < 3; a++) {
                        e[a] = (r[a] * d[0] + r[3 + a] * d[1] + r[6 + a] * d[2]) * scale;
                        e[3 + a] = r[a] * s[0] + r[3 + a] * s[1] + r[6 + a] * s[2];
                    }
                }
            }
        }
        if (have == 0) memset(o, 0, sizeof(float) * 6 * count);
        else
            for (int32_t i = have; i < count; i++) memcpy(o + 6 * i, o + 6 * (i - have), sizeof(float) * 6);
    }
    free(x);
    return 0;
}

/* Samples from..to: which of a sample's m votes lie within the radius of each of its seeds, the first `count` in index
 * order, repeated in turn when there are fewer; the nearest vote when there is none. */
int votes_around(const float *votes, const float *seeds, int64_t from, int64_t to, int32_t m, int32_t per_sample,
                 float squared_radius, int32_t count, int64_t *out) {
    float *x = malloc(sizeof(float) * 4 * (size_t)m), *y = x + m, *z = y + m, *squared = z + m;
    if (!x) return 1;
    for (int64_t s = from; s < to; s++) {
        const float *v = votes + 3 * m * s;
        for (int32_t i = 0; i < m; i++) x[i] = v[3 * i], y[i] = v[3 * i + 1], z[i] = v[3 * i + 2];
        for (int64_t q = s * per_sample; q < (s + 1) * per_sample; q++) {
            const float *p = seeds + 3 * q;
            int64_t *o = out + q * count;
            int32_t have = 0, nearest = 0;
            for (int32_t i = 0; i < m; i++) {
                const float dx = p[0] - x[i], dy = p[1] - y[i], dz = p[2] - z[i];
                squared[i] = dx * dx + dy * dy + dz * dz;
            }
            for (int32_t i = 0; i < m && have < count; i++)
                if (squared[i] <= squared_radius) o[have++] = i;
            if (have == 0) {
                for (int32_t i = 1; i < m; i++) nearest = squared[i] < squared[nearest] ? i : nearest;
                o[have++] = nearest;
            }
            for (int32_t i = have; i < count; i++) o[i] = o[i - have];
        }
    }
    free(x);
    return 0;
}

#define LANES 16
#define BEYOND (1 << 30) /* the voxel of votes that are none */

typedef float many __attribute__((vector_size(4 * LANES), aligned(4)));
typedef int32_t whole __attribute__((vector_size(4 * LANES), aligned(4)));

static inline whole apart(const int32_t *a, int32_t b) {
    const whole d = *(const whole *)a - b, negative = d >> 31;
    return (d ^ negative) - negative;
}

static float total(const many *v) {
    float sum = 0;
    for (int l = 0; l < LANES; l++) sum += (*v)[l];
    return sum;
}

/* One sample: heat of every vote's voxel and the heat-weighted mean of the votes in the 3x3x3 voxels around it. */
static void warm(const float *const p[3], int32_t *const v[3], int32_t m, const float weights[4], float *heat, float *mean) {
    whole bits[4];
    for (int n = 0; n < 4; n++) bits[n] = (whole)((many){0} + weights[n]);
    for (int32_t i = 0; i < m; i++) {
        many sum = {0}, s[3] = {{0}, {0}, {0}};
        for (int32_t j = 0; j < m; j += LANES) {
            const whole x = apart(v[0] + j, v[0][i]), y = apart(v[1] + j, v[1][i]), z = apart(v[2] + j, v[2][i]);
            const whole n = x + y + z, near = (x | y | z) < 2;
            const whole of = ((n == 0) & bits[0]) | ((n == 1) & bits[1]) | ((n == 2) & bits[2]) | ((n == 3) & bits[3]);
            const many w = (many)(near & of);
            sum += w;
            for (int a = 0; a < 3; a++) s[a] += w * (*(const many *)(p[a] + j) - p[a][i]);
        }
        heat[i] = total(&sum);
        for (int a = 0; a < 3; a++) mean[3 * i + a] = p[a][i] + total(s + a) / heat[i];
    }
}

/* One sample: 1 for a vote that has a hotter one (or as hot and earlier) within `window` voxels. */
static void beat(const float *heat, int32_t *const v[3], int32_t m, int32_t window, float tie, float *beaten) {
    whole lane;
    for (int l = 0; l < LANES; l++) lane[l] = l;
    for (int32_t i = 0; i < m; i++) {
        whole any = {0};
        for (int32_t j = 0; j < m; j += LANES) {
            const whole x = apart(v[0] + j, v[0][i]), y = apart(v[1] + j, v[1][i]), z = apart(v[2] + j, v[2][i]);
            const many ahead = *(const many *)(heat + j) - heat[i];
            any |= (x <= window) & (y <= window) & (z <= window) & ((ahead > tie) | ((ahead >= -tie) & (lane + j < i)));
        }
        int32_t found = 0;
        for (int l = 0; l < LANES; l++) found |= any[l];
        beaten[i] = found ? 1.0f : 0.0f;
    }
}

/* Samples from..to of m votes each: heat, beaten (1 or 0) and mean of every vote, as in `warm` and `beat`. */
int heatmap(const float *votes, int64_t from, int64_t to, int32_t m, float voxel, int32_t window, float center, float side,
            float tie, float *heat, float *beaten, float *mean) {
    const size_t padded = ((size_t)m + LANES - 1) / LANES * LANES;
    const float weights[4] = {center, center * side, center * side * side, center * side * side * side};
    float *memory = malloc(sizeof(float) * 7 * padded);
    if (!memory) return 1;
    float *p[3] = {memory, memory + padded, memory + 2 * padded}, *hot = memory + 3 * padded;
    int32_t *v[3];
    for (int a = 0; a < 3; a++) v[a] = (int32_t *)(hot + (size_t)(1 + a) * padded);
    for (int64_t s = from; s < to; s++) {
        const float *of = votes + 3 * m * s;
        for (size_t i = 0; i < padded; i++)
            for (int a = 0; a < 3; a++) {
                p[a][i] = i < (size_t)m ? of[3 * i + a] : 0.0f;
                v[a][i] = i < (size_t)m ? (int32_t)floorf(p[a][i] / voxel) : BEYOND;
            }
        memset(hot, 0, sizeof(float) * padded);
        warm((const float *const *)p, v, m, weights, hot, mean + 3 * m * s);
        beat(hot, v, m, window, tie, beaten + m * s);
        memcpy(heat + m * s, hot, sizeof(float) * m);
    }
    free(memory);
    return 0;
}
