/* Which rays of a sample are cast, which hits stay, and where rays end in the bin: what numpy needs many passes for.
 *
 * Plain C99, called through ctypes (ray_selection.py, raycast.py), which also hold the slow versions that the tests
 * compare with.
 */
#include <float.h>
#include <math.h>
#include <stdint.h>

#define CHUNK 256

/* The numbers below n in the random order in which numpy's Generator.permutation has them, from the same draws: swaps
 * from the end, each with a place drawn from the bits of a mask until it fits. Next is the generator's next_uint32; the
 * draws of a chunk come first, without branches that nobody can foresee. */
int random_order(uint32_t (*next)(void *), void *state, int32_t n, int32_t *order) {
    uint32_t mask = UINT32_MAX, drawn[CHUNK + 1];
    for (int32_t i = 0; i < n; i++) order[i] = i;
    for (int32_t i = n - 1; i > 0;) {
        while (mask >> 1 >= (uint32_t)i) mask >>= 1;
        const int32_t same = i - (int32_t)(mask >> 1), wanted = same < CHUNK ? same : CHUNK; /* of this mask */
        for (int32_t count = 0; count < wanted;) {
            drawn[count] = next(state) & mask;
            count += drawn[count] <= (uint32_t)(i - count);
        }
        for (int32_t d = 0; d < wanted; d++, i--) {
            const int32_t own = order[i];
            order[i] = order[drawn[d]], order[drawn[d]] = own;
        }
    }
    return 0;
}

typedef struct { /* of an instance; see Window in ray_selection.py */
    double low_y, high_y, across_x, across_y, low_across, high_across, near;
} window;

/* Of the rays first..last, sorted by x, those that can be the first to meet an instance: their indices, the rays
 * (x, y, 1), and how many. Fewer than two are not worth it, and one alone would be turned by another routine than many,
 * with another rounding: then all rays in the box. */
int select_rays(const double *x, const double *y, const float *nearest, int32_t first, int32_t last, const window *w,
                int32_t *chosen, float *rays, int32_t *count) {
    for (int narrow = 1; narrow >= 0; narrow--) {
        int32_t n = 0;
        for (int32_t i = first; i < last; i++) {
            const double across = w->across_x * x[i] + w->across_y * y[i];
            const int meets = (across >= w->low_across) & (across <= w->high_across) & (nearest[i] >= w->near);
            chosen[n] = i;
            rays[3 * (int64_t)n] = (float)x[i], rays[3 * (int64_t)n + 1] = (float)y[i], rays[3 * (int64_t)n + 2] = 1;
            n += (y[i] >= w->low_y) & (y[i] <= w->high_y) & (meets | !narrow);
        }
        *count = n;
        if (n > 1) break;
    }
    return 0;
}

/* Keep hits at depth t on an instance's face, -1 for none, where they are nearer than what their rays met before; of
 * equally near instances the one with the lowest index. */
int keep_nearer(const int32_t *chosen, int32_t count, const float *t, const int32_t *hit, int32_t instance,
                float *nearest, int32_t *owner, int32_t *face) {
    for (int32_t i = 0; i < count; i++) {
        const int32_t at = chosen[i];
        if (hit[i] < 0 || t[i] > nearest[at] || (t[i] == nearest[at] && owner[at] < instance)) continue;
        nearest[at] = t[i], owner[at] = instance, face[at] = hit[i];
    }
    return 0;
}

/* Depths at which rays (x, y, 1) from the camera end on floor or walls of the bin, inf for those that miss it;
 * bin_from_camera is 4x4, the size in metres. */
int bin_depth(const double *xy, int32_t n, const double *bin_from_camera, const double *size, double *depth) {
    const double *m = bin_from_camera;
    for (int32_t i = 0; i < n; i++) {
        const double x = xy[2 * (int64_t)i], y = xy[2 * (int64_t)i + 1];
        double enter = -DBL_MAX, leave = DBL_MAX;
        int through_top = 0;
        for (int a = 0; a < 3; a++) {
            const double low = a == 2 ? 0 : -size[a] / 2, high = a == 2 ? size[a] : size[a] / 2;
            const double direction = x * m[4 * a] + (y * m[4 * a + 1] + m[4 * a + 2]);
            const double inverted = 1 / (fabs(direction) < 1e-15 ? 1e-15 : direction);
            const double one = (low - m[4 * a + 3]) * inverted, two = (high - m[4 * a + 3]) * inverted;
            const double near = one < two ? one : two, far = one < two ? two : one;
            through_top = (near > enter) & (direction < 0); /* holds for the last axis, z */
            enter = near > enter ? near : enter, leave = far < leave ? far : leave;
        }
        const double end = through_top ? leave : enter;
        depth[i] = enter < leave && end > 0 ? end : (double)INFINITY;
    }
    return 0;
}
