/* Normals of a point cloud: the direction of least variance of the nearest k points, turned towards the origin.
 *
 * Plain C99, called through ctypes (geometry/pointcloud.py), which also holds the slow version that the tests compare
 * with. The cloud comes sorted along a curve (morton_order in pointops.c): leaves of a few points with boxes, and a
 * binary tree of boxes over them. Queries come sorted alike, so the last one's k-th neighbour says about how far the next
 * has to look. Distances are compared in double precision, ties go to the lower index.
 */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>

#define LEAF 16
#define MARGIN 1.15f /* of the squared distance that the last query needed */
#define FEW 16       /* points too many are removed one by one, more by a partition */

typedef struct {
    float low[3], high[3];
} box;

typedef struct {
    int32_t n, leaves;    /* leaves: a power of two, those beyond the last point are empty */
    box *boxes;           /* boxes[1] holds all, boxes[2 i] and boxes[2 i + 1] are the halves of boxes[i] */
    float *x, *y, *z;     /* points in tree order */
    const int32_t *order; /* original index of each */
} tree;

static void fill_boxes(tree *t) {
    for (int32_t leaf = 0; leaf < t->leaves; leaf++) {
        box *own = t->boxes + t->leaves + leaf;
        for (int a = 0; a < 3; a++) own->low[a] = FLT_MAX, own->high[a] = -FLT_MAX;
        for (int32_t i = leaf * LEAF; i < (leaf + 1) * LEAF && i < t->n; i++) {
            const float p[3] = {t->x[i], t->y[i], t->z[i]};
            for (int a = 0; a < 3; a++) {
                own->low[a] = p[a] < own->low[a] ? p[a] : own->low[a];
                own->high[a] = p[a] > own->high[a] ? p[a] : own->high[a];
            }
        }
    }
    for (int32_t i = t->leaves - 1; i > 0; i--)
        for (int a = 0; a < 3; a++) {
            const box *one = t->boxes + 2 * i, *two = one + 1;
            t->boxes[i].low[a] = one->low[a] < two->low[a] ? one->low[a] : two->low[a];
            t->boxes[i].high[a] = one->high[a] > two->high[a] ? one->high[a] : two->high[a];
        }
}

/* A lower bound of the squared distance from a point to the points of a box; FLT_MAX or more for an empty one. */
static float to_box(const box *b, const float *p) {
    float sum = 0;
    for (int a = 0; a < 3; a++) {
        const float below = b->low[a] - p[a], above = p[a] - b->high[a];
        float d = below > above ? below : above;
        d = d > 0 ? d : 0;
        sum += d * d;
    }
    return sum;
}

/* Places in tree order of all points with a squared distance up to the bound. */
static int32_t collect(const tree *t, const float *p, float bound, int32_t *found) {
    int32_t stack[64], depth = 0, count = 0;
    if (bound >= FLT_MAX) { /* squares of what is that far apart have no single precision */
        for (int32_t i = 0; i < t->n; i++) found[i] = i;
        return t->n;
    }
    stack[depth++] = 1;
    while (depth) {
        const int32_t at = stack[--depth];
        /* The slack covers rounding of the distance to the box. */
        if (to_box(t->boxes + at, p) * 0.99999f > bound) continue;
        if (at < t->leaves) {
            stack[depth++] = 2 * at + 1;
            stack[depth++] = 2 * at;
            continue;
        }
        float squared[LEAF];
        const int32_t from = (at - t->leaves) * LEAF;
        if (from >= t->n) continue;
        const float *x = t->x + from, *y = t->y + from, *z = t->z + from;
        for (int32_t i = 0; i < LEAF; i++) {
            const float dx = x[i] - p[0], dy = y[i] - p[1], dz = z[i] - p[2];
            squared[i] = dx * dx + dy * dy + dz * dz;
        }
        const int32_t size = t->n - from < LEAF ? t->n - from : LEAF; /* beyond lies padding */
        for (int32_t i = 0; i < size; i++) {
            found[count] = from + i;
            count += squared[i] <= bound;
        }
    }
    return count;
}

typedef struct {
    double *squared;
    int32_t *place; /* in tree order */
} candidates;

static int after(const candidates *c, const int32_t *order, double squared, int32_t place, int32_t i) {
    return c->squared[i] > squared || (c->squared[i] == squared && order[c->place[i]] > order[place]);
}

/* Quickselect: the k nearest come first. */
static void keep_nearest(candidates *c, const int32_t *order, int32_t n, int32_t k) {
    int32_t lo = 0, hi = n - 1;
    while (lo < hi) {
        const double pivot = c->squared[lo + (hi - lo) / 2];
        const int32_t own = c->place[lo + (hi - lo) / 2];
        int32_t i = lo, j = hi;
        while (i <= j) {
            while (c->place[i] != own && !after(c, order, pivot, own, i)) i++;
            while (after(c, order, pivot, own, j)) j--;
            if (i <= j) {
                const double squared = c->squared[i];
                const int32_t place = c->place[i];
                c->squared[i] = c->squared[j], c->place[i] = c->place[j];
                c->squared[j] = squared, c->place[j] = place;
                i++, j--;
            }
        }
        if (k - 1 <= j) hi = j;
        else if (k - 1 >= i) lo = i;
        else return;
    }
}

/* The k nearest come first; of equally far ones those with the lowest index. */
static void choose(candidates *c, const int32_t *order, int32_t n, int32_t k) {
    if (n - k > FEW) {
        keep_nearest(c, order, n, k);
        return;
    }
    for (; n > k; n--) {
        double top = c->squared[0];
        for (int32_t i = 1; i < n; i++) top = c->squared[i] > top ? c->squared[i] : top;
        int32_t worst = -1;
        for (int32_t i = 0; i < n; i++)
            if (c->squared[i] == top && (worst < 0 || order[c->place[i]] > order[c->place[worst]])) worst = i;
        c->squared[worst] = c->squared[n - 1], c->place[worst] = c->place[n - 1];
    }
}

/* The k points nearest to p come first; squared distance of the farthest of them. The bound of the search is a guess. */
static double nearest(const tree *t, const float *p, int32_t k, float *bound, int32_t *found, candidates *near) {
    for (;;) {
        /* Points are found in single precision: a few more, so that none within the bound is missed. */
        const int32_t count = collect(t, p, *bound < FLT_MAX / 2 ? *bound * 1.00001f : FLT_MAX, found);
        double farthest = 0;
        if (count >= k) {
            for (int32_t i = 0; i < count; i++) {
                const int32_t at = found[i];
                const double dx = (double)t->x[at] - p[0], dy = (double)t->y[at] - p[1], dz = (double)t->z[at] - p[2];
                near->squared[i] = dx * dx + dy * dy + dz * dz, near->place[i] = at;
            }
            choose(near, t->order, count, k);
            for (int32_t i = 0; i < k; i++) farthest = near->squared[i] > farthest ? near->squared[i] : farthest;
            /* Any ball that holds k points holds the nearest k. */
            if (farthest <= *bound || count == t->n) return farthest;
        }
        *bound = *bound < FLT_MAX / 4 ? *bound * 2 + 1e-30f : FLT_MAX;
    }
}

/* The eigenvector of the smallest eigenvalue of a symmetric matrix, by Jacobi's rotations. */
static void least_direction(double m[3][3], double *normal) {
    double v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    for (int sweep = 0; sweep < 30; sweep++) {
        const double off = fabs(m[0][1]) + fabs(m[0][2]) + fabs(m[1][2]);
        const double all = fabs(m[0][0]) + fabs(m[1][1]) + fabs(m[2][2]);
        if (off <= 1e-15 * all) break;
        for (int p = 0; p < 2; p++)
            for (int q = p + 1; q < 3; q++) {
                if (m[p][q] == 0) continue;
                const double theta = (m[q][q] - m[p][p]) / (2 * m[p][q]);
                const double t = (theta >= 0 ? 1 : -1) / (fabs(theta) + sqrt(theta * theta + 1));
                const double c = 1 / sqrt(t * t + 1), s = t * c;
                const int r = 3 - p - q;
                const double mpq = m[p][q], mpr = m[p][r], mqr = m[q][r];
                m[p][p] -= t * mpq, m[q][q] += t * mpq, m[p][q] = m[q][p] = 0;
                m[p][r] = m[r][p] = c * mpr - s * mqr;
                m[q][r] = m[r][q] = s * mpr + c * mqr;
                for (int a = 0; a < 3; a++) {
                    const double vp = v[a][p], vq = v[a][q];
                    v[a][p] = c * vp - s * vq, v[a][q] = s * vp + c * vq;
                }
            }
    }
    int least = 0;
    for (int a = 1; a < 3; a++)
        if (m[a][a] < m[least][least]) least = a;
    for (int a = 0; a < 3; a++) normal[a] = v[a][least];
}

/* Unit normals of m queries among n points from k of them (1 <= k <= n); order and turn are morton_order of points and
 * queries. Returns 0, or 1 when memory runs out. */
int normals(const float *xyz, const int32_t *order, int32_t n, const float *queries, const int32_t *turn, int32_t m,
            int32_t k, float *out) {
    tree t = {.n = n, .leaves = 1, .order = order};
    while ((int64_t)t.leaves * LEAF < n) t.leaves *= 2;
    const size_t padded = (size_t)n + LEAF;
    float *soa = calloc(3 * padded, sizeof(float));
    int32_t *found = malloc(sizeof(int32_t) * padded);
    candidates near = {malloc(sizeof(double) * padded), malloc(sizeof(int32_t) * padded)};
    t.boxes = malloc(sizeof(box) * 2 * (size_t)t.leaves);
    if (!t.boxes || !soa || !found || !near.squared || !near.place) {
        free(t.boxes), free(soa), free(found), free(near.squared), free(near.place);
        return 1;
    }
    t.x = soa, t.y = soa + padded, t.z = soa + 2 * padded;
    for (int32_t i = 0; i < n; i++) {
        const float *p = xyz + 3 * (int64_t)order[i];
        t.x[i] = p[0], t.y[i] = p[1], t.z[i] = p[2];
    }
    fill_boxes(&t);
    float bound = FLT_MAX;
    for (int32_t s = 0; s < m; s++) {
        const float *p = queries + 3 * (int64_t)turn[s];
        const double farthest = nearest(&t, p, k, &bound, found, &near);
        double mean[3] = {0, 0, 0};
        for (int32_t i = 0; i < k; i++) {
            const int32_t at = near.place[i];
            mean[0] += t.x[at], mean[1] += t.y[at], mean[2] += t.z[at];
        }
        for (int a = 0; a < 3; a++) mean[a] /= k;
        double c[3][3] = {{0}};
        for (int32_t i = 0; i < k; i++) {
            const int32_t at = near.place[i];
            const double dx = t.x[at] - mean[0], dy = t.y[at] - mean[1], dz = t.z[at] - mean[2];
            c[0][0] += dx * dx, c[0][1] += dx * dy, c[0][2] += dx * dz;
            c[1][1] += dy * dy, c[1][2] += dy * dz, c[2][2] += dz * dz;
        }
        c[1][0] = c[0][1], c[2][0] = c[0][2], c[2][1] = c[1][2];
        double normal[3];
        least_direction(c, normal);
        const double sign = normal[0] * p[0] + normal[1] * p[1] + normal[2] * p[2] > 0 ? -1 : 1;
        for (int a = 0; a < 3; a++) out[3 * (int64_t)turn[s] + a] = (float)(sign * normal[a]);
        bound = farthest < FLT_MAX / 4 ? (float)farthest * MARGIN + 1e-30f : FLT_MAX;
    }
    free(t.boxes), free(soa), free(found), free(near.squared), free(near.place);
    return 0;
}
