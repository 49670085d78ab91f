/* Point operators of attentionvote: exact farthest-point order, first-k ball query, nearest neighbours.
 *
 * Plain C99, no dependency, called through ctypes (geometry/sampling.py), which also holds the slow numpy
 * references that the tests compare with. Compile with -O3 -ffinite-math-only -fno-signed-zeros: the running
 * maximum vectorises only then. Never with -ffast-math: linked into a shared object it makes GCC flush
 * subnormals to zero in the whole process.
 *
 * Infinities mean nothing under these flags, so none may arise: clouds beyond WIDEST, whose squares could overflow, are
 * left to the references. Functions return 0, 1 when memory runs out, or 2 for such a cloud.
 */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define BLOCK 64
#define MAX_CELLS_PER_AXIS 1024
#define DIGIT 11 /* bits a pass of the sort */
#define FEW 24   /* numbers that are sorted by insertion */
#define CHUNK 64 /* distances at a time */
#define WIDEST 1e18f     /* metres from the origin on an axis; normals.c has the same */
#define ALL_INSIDE 4e18f /* no two points are as far apart */

typedef struct {
    uint32_t key;
    int32_t index;
} keyed;

/* Lowest and highest coordinates of n points, zeros of none; whether all lie within WIDEST. */
static int bounds(const float *xyz, int32_t n, float *low, float *high) {
    float l[3] = {0, 0, 0}, h[3] = {0, 0, 0}; /* in registers */
    for (int a = 0; a < 3 && n > 0; a++) l[a] = h[a] = xyz[a];
    for (int32_t i = 0; i < n; i++)
        for (int a = 0; a < 3; a++) {
            const float v = xyz[3 * i + a];
            l[a] = v < l[a] ? v : l[a];
            h[a] = v > h[a] ? v : h[a];
        }
    memcpy(low, l, sizeof l), memcpy(high, h, sizeof h);
    int fits = 1;
    for (int a = 0; a < 3; a++) fits &= l[a] >= -WIDEST && h[a] <= WIDEST;
    return fits;
}

static uint32_t spread(uint32_t v) { /* 10 bits, two zero bits between neighbours */
    v = (v | v << 16) & 0x030000ffu;
    v = (v | v << 8) & 0x0300f00fu;
    v = (v | v << 4) & 0x030c30c3u;
    v = (v | v << 2) & 0x09249249u;
    return v;
}

/* Indices of the points along a Morton curve through 1024 cells an axis, points of one cell in index order: points that
 * are near each other in space mostly are so in the order. */
int morton_order(const float *xyz, int32_t n, int32_t *order) {
    float low[3], high[3];
    if (!bounds(xyz, n, low, high)) return 2;
    keyed *from = malloc(sizeof(keyed) * ((size_t)n + 1)), *to = malloc(sizeof(keyed) * ((size_t)n + 1));
    if (!from || !to) {
        free(from), free(to);
        return 1;
    }
    float extent = 1e-12f;
    for (int a = 0; a < 3; a++)
        if (high[a] - low[a] > extent) extent = high[a] - low[a];
    for (int32_t i = 0; i < n; i++) {
        uint32_t key = 0;
        for (int a = 0; a < 3; a++) key |= spread((uint32_t)((xyz[3 * i + a] - low[a]) / extent * 1023.0f)) << a;
        from[i].key = key;
        from[i].index = i;
    }
    for (int shift = 0; shift < 30; shift += DIGIT) { /* stable: equal keys stay in index order */
        int32_t start[(1 << DIGIT) + 1] = {0};
        for (int32_t i = 0; i < n; i++) start[((from[i].key >> shift) & ((1 << DIGIT) - 1)) + 1]++;
        for (int d = 0; d < 1 << DIGIT; d++) start[d + 1] += start[d];
        for (int32_t i = 0; i < n; i++) to[start[(from[i].key >> shift) & ((1 << DIGIT) - 1)]++] = from[i];
        keyed *t = from;
        from = to, to = t;
    }
    for (int32_t i = 0; i < n; i++) order[i] = from[i].index;
    free(from), free(to);
    return 0;
}

/* Farthest-point order: order[0] = 0, then always the point farthest from all chosen ones, ties to the lowest
 * index. Points are sorted along a Morton curve into blocks with bounding boxes; a block is visited only when
 * the new sample can be nearer than the block's current maximum. */
int farthest_point_order(const float *xyz, int32_t n, int32_t m, int32_t *order) {
    const int32_t blocks = (n + BLOCK - 1) / BLOCK, padded = blocks * BLOCK;
    float *soa = malloc(sizeof(float) * 4 * (size_t)padded);
    int32_t *original = malloc(sizeof(int32_t) * (size_t)padded);
    float *box = malloc(sizeof(float) * 8 * (size_t)blocks);
    const int failed = soa && original && box ? morton_order(xyz, n, original) : 1;
    if (failed) {
        free(soa), free(original), free(box);
        return failed;
    }
    for (int32_t i = n; i < padded; i++) original[i] = original[n - 1];
    float *x = soa, *y = soa + padded, *z = soa + 2 * padded, *d = soa + 3 * padded;
    for (int32_t i = 0; i < padded; i++) {
        const int32_t j = original[i];
        x[i] = xyz[3 * j], y[i] = xyz[3 * j + 1], z[i] = xyz[3 * j + 2];
        d[i] = i < n ? FLT_MAX : -1.0f; /* padding is never the farthest */
    }
    float *lx = box, *hx = box + blocks, *ly = box + 2 * blocks, *hy = box + 3 * blocks, *lz = box + 4 * blocks,
          *hz = box + 5 * blocks, *farthest = box + 6 * blocks, *bound = box + 7 * blocks;
    for (int32_t b = 0; b < blocks; b++) {
        const int32_t s = b * BLOCK;
        lx[b] = hx[b] = x[s], ly[b] = hy[b] = y[s], lz[b] = hz[b] = z[s];
        for (int32_t i = s; i < s + BLOCK; i++) {
            lx[b] = x[i] < lx[b] ? x[i] : lx[b], hx[b] = x[i] > hx[b] ? x[i] : hx[b];
            ly[b] = y[i] < ly[b] ? y[i] : ly[b], hy[b] = y[i] > hy[b] ? y[i] : hy[b];
            lz[b] = z[i] < lz[b] ? z[i] : lz[b], hz[b] = z[i] > hz[b] ? z[i] : hz[b];
        }
        farthest[b] = FLT_MAX;
    }
    int32_t chosen = 0;
    for (int32_t step = 0; step < m; step++) {
        order[step] = chosen;
        const float px = xyz[3 * chosen], py = xyz[3 * chosen + 1], pz = xyz[3 * chosen + 2];
        for (int32_t b = 0; b < blocks; b++) { /* without branches: four boxes at a time */
            float dx = lx[b] - px > px - hx[b] ? lx[b] - px : px - hx[b];
            float dy = ly[b] - py > py - hy[b] ? ly[b] - py : py - hy[b];
            float dz = lz[b] - pz > pz - hz[b] ? lz[b] - pz : pz - hz[b];
            dx = dx > 0.0f ? dx : 0.0f, dy = dy > 0.0f ? dy : 0.0f, dz = dz > 0.0f ? dz : 0.0f;
            /* The slack covers rounding of the bound, so that pruning never changes the result. */
            bound[b] = (dx * dx + dy * dy + dz * dz) * 0.99999f;
        }
        for (int32_t b = 0; b < blocks; b++) {
            if (bound[b] >= farthest[b]) continue;
            const int32_t s = b * BLOCK;
            float top = -1.0f;
            for (int32_t i = s; i < s + BLOCK; i++) {
                const float ex = x[i] - px, ey = y[i] - py, ez = z[i] - pz;
                const float e = ex * ex + ey * ey + ez * ez;
                d[i] = d[i] < e ? d[i] : e;
                top = top > d[i] ? top : d[i];
            }
            farthest[b] = top;
        }
        float top = -2.0f;
        for (int32_t b = 0; b < blocks; b++) top = top > farthest[b] ? top : farthest[b];
        int32_t lowest = INT32_MAX;
        for (int32_t b = 0; b < blocks; b++) {
            if (farthest[b] != top) continue;
            for (int32_t i = b * BLOCK; i < (b + 1) * BLOCK; i++)
                if (d[i] == top && original[i] < lowest) lowest = original[i];
        }
        chosen = lowest;
    }
    free(soa), free(original), free(box);
    return 0;
}

/* The k smallest of n different numbers below 64 * words, in order. Few are sorted by insertion; of many the bits of a
 * set, which is empty before and after, are read off until k are found. Returns how many there are, at most k. */
static int32_t smallest_in_order(int32_t *v, int32_t n, int32_t k, uint64_t *set, int32_t words) {
    if (n <= FEW) {
        for (int32_t i = 1; i < n; i++) {
            const int32_t own = v[i];
            int32_t j = i;
            for (; j > 0 && v[j - 1] > own; j--) v[j] = v[j - 1];
            v[j] = own;
        }
        return n < k ? n : k;
    }
    for (int32_t i = 0; i < n; i++) set[v[i] >> 6] |= (uint64_t)1 << (v[i] & 63);
    int32_t count = 0;
    for (int32_t w = 0; w < words && count < k; w++)
        for (uint64_t bits = set[w]; bits && count < k; bits &= bits - 1)
            v[count++] = 64 * w + __builtin_ctzll(bits);
    memset(set, 0, sizeof(uint64_t) * (size_t)words);
    return count;
}

/* Cells that a grid has, and how many along each axis; one when the cell is larger than the points' box. */
static int64_t grid(const float *low, const float *high, double cell, int64_t *cells) {
    for (int a = 0; a < 3; a++) cells[a] = (int64_t)(((double)high[a] - low[a]) / cell) + 1;
    return cells[0] * cells[1] * cells[2];
}

/* For every centre the first k points in index order with distance <= radius, padded with the first; counts[c]
 * is the number of real neighbours (at most k). An empty ball has count 0 and index 0. */
int ball_query(const float *xyz, int32_t n, const float *centers, int32_t m, float radius, int32_t k,
               int32_t *neighbors, int32_t *counts) {
    float low[3], high[3], far[6];
    if (!bounds(xyz, n, low, high) || !bounds(centers, m, far, far + 3)) return 2;
    radius = radius < ALL_INSIDE ? radius : ALL_INSIDE;
    double cell = radius;
    for (int a = 0; a < 3; a++) cell = fmax(cell, ((double)high[a] - low[a]) / (MAX_CELLS_PER_AXIS - 1));
    if (cell == 0) cell = 1;
    int64_t cells[3];
    while (grid(low, high, cell, cells) > 8 * (int64_t)n + 64) cell *= 1.5; /* coarser is slower, never wrong */
    const int64_t total = grid(low, high, cell, cells);
    const double inverse = 1 / cell;
    int32_t *start = calloc((size_t)total + 2, sizeof(int32_t));
    int32_t *cell_of = malloc(sizeof(int32_t) * ((size_t)n + 1));
    int32_t *sorted = malloc(sizeof(int32_t) * ((size_t)n + 1));
    const int32_t words = n / 64 + 1;
    float *soa = malloc(sizeof(float) * 3 * ((size_t)n + 1));
    int32_t *found = malloc(sizeof(int32_t) * ((size_t)n + 1));
    uint64_t *set = calloc((size_t)words, sizeof(uint64_t));
    if (!start || !cell_of || !sorted || !soa || !found || !set) {
        free(start), free(cell_of), free(sorted), free(soa), free(found), free(set);
        return 1;
    }
    float *x = soa, *y = soa + n, *z = soa + 2 * (size_t)n; /* by cell */
    for (int32_t i = 0; i < n; i++) {
        int64_t c[3];
        for (int a = 0; a < 3; a++) {
            c[a] = (int64_t)(((double)xyz[3 * i + a] - low[a]) * inverse);
            if (c[a] >= cells[a]) c[a] = cells[a] - 1;
        }
        cell_of[i] = (int32_t)((c[2] * cells[1] + c[1]) * cells[0] + c[0]);
        start[cell_of[i] + 2]++;
    }
    for (int64_t c = 0; c < total; c++) start[c + 2] += start[c + 1];
    for (int32_t i = 0; i < n; i++) {
        const int32_t slot = start[cell_of[i] + 1]++;
        sorted[slot] = i;
        x[slot] = xyz[3 * i], y[slot] = xyz[3 * i + 1], z[slot] = xyz[3 * i + 2];
    }
    const float squared = radius * radius;
    /* Squares are rounded, tiny ones to multiples of 1e-45: a point on the border must not be lost. */
    const double reach = radius * (1 + 1e-6) + 1e-22;
    for (int32_t q = 0; q < m; q++) {
        const float *p = centers + 3 * q;
        int64_t from[3], to[3];
        for (int a = 0; a < 3; a++) {
            const double first = (p[a] - reach - low[a]) * inverse, last = (p[a] + reach - low[a]) * inverse;
            from[a] = first < 0 ? 0 : first < cells[a] ? (int64_t)first : cells[a];
            to[a] = last < 0 ? -1 : last < cells[a] ? (int64_t)last : cells[a] - 1;
        }
        int32_t count = 0;
        for (int64_t cz = from[2]; cz <= to[2]; cz++)
            for (int64_t cy = from[1]; cy <= to[1]; cy++) {
                if (from[0] > to[0]) continue;
                const int64_t row = (cz * cells[1] + cy) * cells[0];
                const int32_t end = start[row + to[0] + 1];
                for (int32_t s = start[row + from[0]]; s < end; s += CHUNK) {
                    const int32_t size = end - s < CHUNK ? end - s : CHUNK;
                    float distance[CHUNK];
                    for (int32_t i = 0; i < size; i++) {
                        const float dx = x[s + i] - p[0], dy = y[s + i] - p[1], dz = z[s + i] - p[2];
                        distance[i] = dx * dx + dy * dy + dz * dz;
                    }
                    for (int32_t i = 0; i < size; i++) {
                        found[count] = sorted[s + i];
                        count += distance[i] <= squared;
                    }
                }
            }
        int32_t *out = neighbors + (int64_t)q * k;
        counts[q] = smallest_in_order(found, count, k, set, words);
        for (int32_t j = 0; j < k; j++) out[j] = counts[q] == 0 ? 0 : found[j < counts[q] ? j : 0];
    }
    free(start), free(cell_of), free(sorted), free(soa), free(found), free(set);
    return 0;
}

/* The three nearest sources of every target with squared distances, nearest first, ties to the lower index;
 * with fewer than three sources the last one is repeated. */
int three_nearest(const float *sources, int32_t n, const float *targets, int32_t m, int32_t *neighbors,
                  float *squared) {
    float low[3], high[3];
    if (!bounds(sources, n, low, high) || !bounds(targets, m, low, high)) return 2;
    for (int32_t t = 0; t < m; t++) {
        float d[3] = {FLT_MAX, FLT_MAX, FLT_MAX};
        int32_t at[3] = {0, 0, 0};
        const float *p = targets + 3 * t;
        for (int32_t i = 0; i < n; i++) {
            const float dx = sources[3 * i] - p[0], dy = sources[3 * i + 1] - p[1], dz = sources[3 * i + 2] - p[2];
            const float e = dx * dx + dy * dy + dz * dz;
            if (e >= d[2]) continue;
            if (e < d[0]) d[2] = d[1], at[2] = at[1], d[1] = d[0], at[1] = at[0], d[0] = e, at[0] = i;
            else if (e < d[1]) d[2] = d[1], at[2] = at[1], d[1] = e, at[1] = i;
            else d[2] = e, at[2] = i;
        }
        for (int32_t j = 1; j < 3; j++)
            if (j >= n) d[j] = d[n - 1], at[j] = at[n - 1];
        memcpy(squared + 3 * t, d, sizeof d);
        memcpy(neighbors + 3 * t, at, sizeof at);
    }
    return 0;
}
