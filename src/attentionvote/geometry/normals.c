/* Normals of a point cloud: the direction of least variance of the nearest k points, turned towards the origin.
 *
 * Plain C99, called through ctypes (geometry/pointcloud.py), which also holds the slow version that the tests compare
 * with. The cloud comes sorted along a curve (morton_order in pointops.c): leaves of a few points with boxes, twigs of
 * a few leaves with boxes. Queries come sorted alike: a few that lie together share the leaves around them, and the
 * last one's k-th neighbour says about how far the next has to look. Single precision decides where it can, else double
 * precision, and ties go to the lower index. Loops over LEAF or LANES are vectorised. No infinity may arise, as in
 * pointops.c: what lies beyond WIDEST is refused, and guesses stay between SMALLEST and 2 * LARGEST.
 */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define LEAF 16
#define LANES 8          /* eigenvectors at a time */
#define GROUP 4          /* most queries that share their leaves */
#define SPREAD 2         /* squared diagonal of their box, in squared distances that a query needs */
#define MARGIN 1.3f      /* of the squared distance that the last query needed */
#define REACH 1.5f       /* of that again: how far the leaves of a group are complete */
#define SLACK 1.00001f   /* covers rounding of squared distances in single precision */
#define SMALLEST 1e-30f  /* smaller and larger ones have no single precision */
#define LARGEST (FLT_MAX / 8)
#define WIDEST 1e18f     /* metres from the origin on an axis, as in pointops.c: no square overflows */
#define ZERO 1e-100      /* of a covariance: the square of a quotient by more than that is finite */
#define FAR 8e18f        /* where padding lies: farther from all than 2 * LARGEST, yet its square is finite, too */

typedef double lanes[LANES];
typedef struct { float low[3], high[3]; } box;
typedef struct { float low[3][LEAF], high[3][LEAF]; } boxes; /* axis after axis: all are looked at together */
typedef struct {
    int32_t n, twigs;     /* LEAF points a leaf, LEAF leaves a twig */
    boxes *leaf, *twig;   /* of a twig's leaves, of LEAF twigs; those beyond the last point are empty */
    float *x, *y, *z;     /* points in tree order, padded with some that are far from all */
    const int32_t *order; /* original index of each */
} tree;

static void widen(float *low, float *high, float v) {
    *low = v < *low ? v : *low;
    *high = v > *high ? v : *high;
}

static int narrow(const float *xyz, int32_t n) {
    float most = 0;
    for (int64_t i = 0; i < 3 * (int64_t)n; i++) most = fabsf(xyz[i]) > most ? fabsf(xyz[i]) : most;
    return most <= WIDEST;
}

static void fill_boxes(tree *t) {
    for (int32_t i = 0; i < t->twigs + t->twigs / LEAF + 1; i++) /* twigs' boxes lie behind those of leaves */
        for (int a = 0; a < 3; a++)
            for (int j = 0; j < LEAF; j++) t->leaf[i].low[a][j] = FAR, t->leaf[i].high[a][j] = -FAR;
    for (int32_t i = 0; i < t->n; i++) {
        const float p[3] = {t->x[i], t->y[i], t->z[i]};
        const int32_t leaf = i / LEAF, twig = leaf / LEAF;
        boxes *leaves = t->leaf + twig, *twigs = t->twig + twig / LEAF;
        for (int a = 0; a < 3; a++) {
            widen(&leaves->low[a][leaf % LEAF], &leaves->high[a][leaf % LEAF], p[a]);
            widen(&twigs->low[a][twig % LEAF], &twigs->high[a][twig % LEAF], p[a]);
        }
    }
}

/* Lower bounds of the squared distances from a box of queries to points of LEAF boxes; too large for empty ones. */
static void between(const boxes *b, const box *queries, float *squared) {
    for (int j = 0; j < LEAF; j++) {
        float d[3];
        for (int a = 0; a < 3; a++) {
            const float below = b->low[a][j] - queries->high[a], above = queries->low[a] - b->high[a][j];
            d[a] = below > above ? below : above;
            d[a] = d[a] > 0 ? d[a] : 0;
        }
        squared[j] = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    }
}

typedef struct {
    box queries;
    float reach; /* squared distance from any query in the box up to which the leaves hold all points */
    int32_t count, *leaves;
} surroundings;

static void collect(const tree *t, surroundings *s) {
    float to_twig[LEAF], to_leaf[LEAF], bound = s->reach * SLACK * SLACK;
    s->count = 0;
    for (int32_t i = 0; i < t->twigs; i++) {
        if (i % LEAF == 0) between(t->twig + i / LEAF, &s->queries, to_twig);
        if (to_twig[i % LEAF] > bound) continue;
        between(t->leaf + i, &s->queries, to_leaf);
        for (int32_t j = 0; j < LEAF; j++) {
            s->leaves[s->count] = i * LEAF + j;
            s->count += to_leaf[j] <= bound;
        }
    }
}

/* Take a query into a box unless its squared diagonal becomes too long. */
static int join(box *queries, const float *p, float longest) {
    box wide = *queries;
    float diagonal = 0;
    for (int a = 0; a < 3; a++) {
        widen(&wide.low[a], &wide.high[a], p[a]);
        diagonal += (wide.high[a] - wide.low[a]) * (wide.high[a] - wide.low[a]);
    }
    if (diagonal <= longest) *queries = wide;
    return diagonal <= longest;
}

typedef struct { float *about; double *squared; int32_t *place; } candidates; /* about: squared, in single precision */

/* Of the points at n places the k nearest to p come first, sorted; of equally far ones those with the lowest index. */
static void choose(const tree *t, const float *p, candidates *near, int32_t n, int32_t k) {
    for (int32_t i = 0, kept = 0; i < n; i++) {
        const int32_t at = near->place[i];
        const double dx = (double)t->x[at] - p[0], dy = (double)t->y[at] - p[1], dz = (double)t->z[at] - p[2];
        const double squared = dx * dx + dy * dy + dz * dz;
        int32_t to = kept;
        for (; to > 0; to--) {
            const double other = near->squared[to - 1];
            if (other < squared || (other == squared && t->order[near->place[to - 1]] < t->order[at])) break;
            if (to < k) near->squared[to] = other, near->place[to] = near->place[to - 1];
        }
        if (to < k) near->squared[to] = squared, near->place[to] = at;
        kept += kept < k;
    }
}

static int32_t within(const float *squared, int32_t n, float bound) {
    int32_t count = 0;
    for (int32_t i = 0; i < n; i++) count += squared[i] <= bound;
    return count;
}

/* Places and distances of the points up to a squared distance, a few more because of the rounding. */
static int32_t find(const tree *t, const float *p, const surroundings *s, float bound, candidates *near) {
    int32_t n = 0;
    for (int32_t l = 0; l < s->count; l++) {
        const int32_t from = s->leaves[l] * LEAF;
        const float *x = t->x + from, *y = t->y + from, *z = t->z + from;
        float squared[LEAF];
        for (int32_t i = 0; i < LEAF; i++) {
            const float dx = x[i] - p[0], dy = y[i] - p[1], dz = z[i] - p[2];
            squared[i] = dx * dx + dy * dy + dz * dz;
        }
        for (int32_t i = 0; i < LEAF; i++) {
            near->about[n] = squared[i], near->place[n] = from + i;
            n += squared[i] <= bound * SLACK;
        }
    }
    return n;
}

/* The k points nearest to p come first; 0 where fewer lie within reach. The guess of the squared distance of the
 * farthest of them becomes what it is, or a little more. */
static int nearest(const tree *t, const float *p, int32_t k, const surroundings *s, float *guess, candidates *near) {
    float low = 0, high = *guess < s->reach ? *guess : s->reach;
    int32_t below = 0, n = find(t, p, s, high, near), inside = within(near->about, n, high);
    for (double factor = 1.5; inside < k; factor *= factor) { /* a few steps to any magnitude */
        if (high >= s->reach) return 0;
        low = high, below = inside, high = (float)fmin(high * factor, s->reach);
        n = find(t, p, s, high, near), inside = within(near->about, n, high);
    }
    for (int tries = 1; inside > k && tries <= (inside > 8 * k && high > SMALLEST ? 72 : 12); tries++) {
        /* On a surface the number of points grows with the squared distance; else with any power of it. */
        const float share = tries % 4 ? ((float)(k - below) + 0.5f) / (float)(inside - below) : 0.5f;
        const float power = sqrtf(low > SMALLEST ? low : SMALLEST) * sqrtf(high);
        const float middle = tries > 12 ? power : low + (high - low) * share;
        const int32_t now = within(near->about, n, middle);
        if (now < k) low = middle, below = now;
        else high = middle, inside = now;
    }
    *guess = high = high > SMALLEST ? high : SMALLEST;
    int32_t kept = 0;
    for (int32_t i = 0; i < n; i++) {
        near->place[kept] = near->place[i];
        kept += near->about[i] <= high * SLACK;
    }
    if (kept > k) choose(t, p, near, kept, k);
    return 1;
}

/* The same where the leaves of the group, complete up to s->reach, do not suffice. */
static void nearest_alone(const tree *t, const float *p, int32_t k, surroundings *s, float *guess, candidates *near) {
    s->queries = (box){{p[0], p[1], p[2]}, {p[0], p[1], p[2]}};
    for (double factor = 2; s->reach < LARGEST; factor *= factor) {
        *guess = s->reach = (float)fmin(s->reach * factor, LARGEST);
        collect(t, s);
        if (nearest(t, p, k, s, guess, near)) return;
    }
    for (int32_t i = 0; i < t->n; i++) near->place[i] = i;
    choose(t, p, near, t->n, k);
    *guess = (float)near->squared[k - 1] + SMALLEST;
}

/* One of Jacobi's rotations, of those matrices that are not diagonal yet. */
static inline void rotate(lanes m[3][3], lanes v[3][3], const lanes busy, int p, int q, int r) {
    lanes theta, sign; /* loops of their own: GCC vectorises no branches */
    for (int l = 0; l < LANES; l++) {
        const double done = fabs(m[p][q][l]) <= ZERO ? 1.0 : 0.0;
        theta[l] = (m[q][q][l] - m[p][p][l]) / (2 * m[p][q][l] + done);
        sign[l] = busy[l] - busy[l] * done;
    }
    for (int l = 0; l < LANES; l++) sign[l] = theta[l] >= 0 ? sign[l] : -sign[l];
    for (int l = 0; l < LANES; l++) {
        const double mpq = m[p][q][l], mpr = m[p][r][l], mqr = m[q][r][l];
        const double t = sign[l] / (fabs(theta[l]) + sqrt(theta[l] * theta[l] + 1));
        const double c = 1 / sqrt(t * t + 1), s = t * c;
        m[p][p][l] -= t * mpq, m[q][q][l] += t * mpq, m[p][q][l] = m[q][p][l] = 0;
        m[p][r][l] = m[r][p][l] = c * mpr - s * mqr;
        m[q][r][l] = m[r][q][l] = s * mpr + c * mqr;
        for (int a = 0; a < 3; a++) {
            const double vp = v[a][p][l], vq = v[a][q][l];
            v[a][p][l] = c * vp - s * vq, v[a][q][l] = s * vp + c * vq;
        }
    }
}

/* The eigenvectors of the smallest eigenvalues of LANES symmetric matrices. */
static void least_directions(lanes m[3][3], lanes normal[3]) {
    lanes v[3][3] = {{{0}}}, busy;
    for (int l = 0; l < LANES; l++) v[0][0][l] = v[1][1][l] = v[2][2][l] = 1;
    for (int sweep = 0; sweep < 30; sweep++) {
        double any = 0;
        for (int l = 0; l < LANES; l++) {
            const double off = fabs(m[0][1][l]) + fabs(m[0][2][l]) + fabs(m[1][2][l]);
            const double all = fabs(m[0][0][l]) + fabs(m[1][1][l]) + fabs(m[2][2][l]);
            any += busy[l] = off <= 1e-15 * all ? 0 : 1;
        }
        if (any == 0) break;
        rotate(m, v, busy, 0, 1, 2), rotate(m, v, busy, 0, 2, 1), rotate(m, v, busy, 1, 2, 0);
    }
    for (int l = 0; l < LANES; l++) {
        const int smaller = m[1][1][l] < m[0][0][l], least = m[2][2][l] < m[smaller][smaller][l] ? 2 : smaller;
        for (int a = 0; a < 3; a++) normal[a][l] = v[a][least][l];
    }
}

/* Covariances of the k points at places, as matrix number l. */
static void moments(const tree *t, const int32_t *place, int32_t k, lanes m[3][3], int32_t l) {
    double x = 0, y = 0, z = 0, xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
    for (int32_t i = 0; i < k; i++) x += t->x[place[i]], y += t->y[place[i]], z += t->z[place[i]];
    x /= k, y /= k, z /= k;
    for (int32_t i = 0; i < k; i++) {
        const int32_t at = place[i];
        const double dx = t->x[at] - x, dy = t->y[at] - y, dz = t->z[at] - z;
        xx += dx * dx, xy += dx * dy, xz += dx * dz, yy += dy * dy, yz += dy * dz, zz += dz * dz;
    }
    m[0][0][l] = xx, m[1][1][l] = yy, m[2][2][l] = zz;
    m[0][1][l] = m[1][0][l] = xy, m[0][2][l] = m[2][0][l] = xz, m[1][2][l] = m[2][1][l] = yz;
}

/* Unit normals of m queries among n points from k of them (1 <= k <= n); order and turn are morton_order of points and
 * queries. Returns 0, 1 when memory runs out, or 2 when anything lies beyond WIDEST. */
int normals(const float *xyz, const int32_t *order, int32_t n, const float *queries, const int32_t *turn, int32_t m,
            int32_t k, float *out) {
    if (!narrow(xyz, n) || !narrow(queries, m)) return 2;
    const size_t size = (size_t)n + LEAF;
    tree t = {.n = n, .twigs = (n + LEAF * LEAF - 1) / (LEAF * LEAF), .order = order};
    const size_t leaves = (size_t)t.twigs * LEAF, all = (size_t)t.twigs + t.twigs / LEAF + 1;
    double *room = malloc(size * (sizeof(double) + 5 * sizeof(float)) + leaves * sizeof(double) + all * sizeof(boxes));
    if (!room) return 1;
    t.leaf = (boxes *)(room + size), t.twig = t.leaf + t.twigs;
    t.x = (float *)(t.leaf + all), t.y = t.x + size, t.z = t.y + size;
    candidates near = {t.z + size, room, (int32_t *)(t.z + 2 * size)};
    surroundings group = {.leaves = near.place + size}, alone = {.leaves = near.place + size + leaves};
    for (int32_t i = 0; i < n; i++) {
        const float *p = xyz + 3 * (int64_t)order[i];
        t.x[i] = p[0], t.y[i] = p[1], t.z[i] = p[2];
    }
    for (int32_t i = n; i < n + LEAF; i++) t.x[i] = t.y[i] = t.z[i] = FAR;
    fill_boxes(&t);
    lanes c[3][3] = {{{0}}}, normal[3];
    const float side = t.leaf->high[0][0] - t.leaf->low[0][0];
    float guess = side * side + SMALLEST;
    for (int32_t s = 0, end = 0; s < m; s++) {
        const float *p = queries + 3 * (int64_t)turn[s];
        /* Where the last query lay, its neighbours are this one's: a cloud that repeats a place takes no longer. */
        if (!s || memcmp(p, queries + 3 * (int64_t)turn[s - 1], 3 * sizeof *p)) {
            if (s >= end) {
                group.queries = (box){{p[0], p[1], p[2]}, {p[0], p[1], p[2]}};
                for (end = s + 1; end < m && end < s + GROUP; end++)
                    if (!join(&group.queries, queries + 3 * (int64_t)turn[end], guess * SPREAD)) break;
                if ((group.reach = guess * REACH) < LARGEST) collect(&t, &group);
            }
            alone.reach = group.reach;
            if (group.reach >= LARGEST || !nearest(&t, p, k, &group, &guess, &near))
                nearest_alone(&t, p, k, &alone, &guess, &near);
            guess *= MARGIN;
        }
        const int32_t lane = s % LANES;
        moments(&t, near.place, k, c, lane);
        if (lane < LANES - 1 && s < m - 1) continue;
        least_directions(c, normal);
        for (int32_t l = 0; l <= lane; l++) {
            const int64_t to = 3 * (int64_t)turn[s - lane + l];
            double along = 0;
            for (int a = 0; a < 3; a++) along += normal[a][l] * queries[to + a];
            for (int a = 0; a < 3; a++) out[to + a] = (float)(along > 0 ? -normal[a][l] : normal[a][l]);
        }
    }
    free(room);
    return 0;
}
