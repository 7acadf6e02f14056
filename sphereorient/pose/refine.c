/* The fit of poses, pose by pose: what `refine` of fit.py computes with `disk_sums` of residuals.py, which define it.

   Built for several instruction sets without fused or reordered arithmetic: all of them give the same bits. Stages over
   blocks of pixels keep their data in the first cache. Pictures in single precision, sums in double. */

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "../sphere/cells.h"

#define LANES 16
#define NODES 6       /* most look-ups of a pixel */
#define TINTS 15      /* monomials up to order 4 */
#define SLOPES 10     /* the same up to order 3, of the light's slope */
#define COLUMNS 36    /* 6 of the pose, and most coefficients of a frame's own light */
#define HARMONICS 9
#define EDGE_COLUMNS (4 + 2 * NODES)
#define EVERY 4       /* n-th place suffices for numbers of a whole disk: they are in order of distance */
#define MOST_ROUNDS 16 /* of a place in a picture */
#define TWO_PI 6.283185307179586

typedef struct {
    const float *rows; /* (side^2, 4): a tangent plane for each cell of directions */
    int64_t side;
} Table;

typedef struct {
    int64_t disks, places, inner, cameras, tiles, instants, origins;
    /* pictures, (disks, places) */
    const float *grey, *behind;
    const uint8_t *inside, *clipped;
    /* geometry: (disks, 3, places), (disks, 3, origins), (disks, 2, 3), (disks), (disks) */
    const float *direction, *origin, *axes, *pitch_rad, *pitch_mm;
    const double *moved; /* (disks, 6), rad and mm while the shutter is open, or none */
    const double *instant; /* (instants), of the exposure, from its middle */
    const float *shares;   /* (instants) */
    const int64_t *tile;   /* (places) */
    /* the model */
    float radius_mm, blur_px;
    Table paint, unseen;
    float unseen_most, known_least, cover_least, sine_most, noise_least, tukey2, outliers;
    const float *edge; /* (edges, EDGE_COLUMNS) from -edge_most to edge_most */
    int64_t edges;
    float edge_most, edge_far; /* the table's end; farther from the limb it cuts off nothing, or all */
    int64_t light_kind; /* see `shine`; its map: of 0 (cameras, side, side, 2), of 1 (side^2, 3) */
    const float *light;
    int64_t light_side;
    const float *cover; /* of light in the lab, (depths, 2) */
    int64_t depths;
    const float *gain, *noise, *stray; /* (cameras), (cameras, 4), (cameras, HARMONICS) */
    int64_t n_difference, n_black;     /* columns of a frame's own light */
    /* where the fits begin: (poses, 3), (poses, 3, 3), (poses, cameras), (poses, 3, 3) or none */
    const double *start, *start_rotation;
    const uint8_t *use;
    const double *place_precision;
    int64_t iterations; /* 0: only `kept` is asked for */
    int64_t passing;    /* whether only the pose is asked for, to go on from */
    const float *limb_px; /* (cameras), or none */
    const float *lean;    /* (cameras, 2, SLOPES), or none */
    const float *dark;    /* (cameras) */
    float in_sight;
    float edge_px;
    /* occluders: share of a disk that they may cover, 0: none are sought; see fit.py */
    float most_hidden, covered, most_each, least_of_window;
    int64_t window, margin;        /* half widths, px */
    const int64_t *place;          /* (2, places), px to the right and below */
    /* of `linearise`: expected grey levels and weights of an earlier call, (disks, places), or none; its output for
       each place, (disks, FLOATS + 2, places), as `Disk`, then expected and weight; and of each disk */
    const float *expected, *weight;
    float *columns;
    double *coefficients, *deviation; /* (disks, n_difference + n_black), (disks) */
    /* results: places that count, (disks, places), and the parts of `FittedPoses` */
    uint8_t *kept;
    double *position, *rotation, *covariance, *own_turn, *own_covariance, *own_move, *own_sigma, *limb_coverage, *excess;
    double *score, *nll, *step;
} Task;

/* Where one disk stands in the fit, and what a step needs of it. */
typedef struct {
    const double *position, *rotation; /* of the pose */
    uint8_t *kept;                     /* (places), inside and not hidden by an occluder */
    float *expected, *weight;          /* (places) */
    int first, last;                   /* whether these are unknown; whether scores and `figures` are asked for */
    double *scores;                    /* (tiles, n), n = 6 + n_difference + n_black */
    double normal[COLUMNS * COLUMNS], gradient[COLUMNS];
    double coefficients[COLUMNS], deviation;
    double information[36], pull[6];
    double figures[4];      /* share of variance explained, loss, median step from black to white, limb that counts, 1/mm */
    double to_centre[3]; /* from the camera, mm */
} Sums;

/* What is known of the places of one disk. */
typedef struct {
    float *paint, *cover, *x, *y, *aside, *out[3], *turn[3], *move[3], *limb[3], *count;
    float *difference, *black, *beside, *residual, *variance, *lit, *sorted;
    uint8_t *known, *counts;
    double (*sums)[LANES]; /* of pairs of columns, and of each with what is left */
    float *grid[4]; /* of the square about the disk, wider by the margin on each side */
    int64_t first[2], width, height; /* of that square: least of `place`, and sizes with margins */
} Disk;

enum { FLOATS = 24 };

/* Add products of two blocks of places to sums in lanes, the same for every width of the processor's vectors. */
static inline void add_products(const float *restrict a, const float *restrict b, double *restrict sums) {
    float lanes[LANES] = {0};
    for (int i = 0; i < BLOCK; i += LANES)
        for (int l = 0; l < LANES; l++) lanes[l] += a[i + l] * b[i + l];
    for (int l = 0; l < LANES; l++) sums[l] += (double)lanes[l];
}

static double total(const double *lanes) {
    double sum = 0;
    for (int l = 0; l < LANES; l++) sum += lanes[l];
    return sum;
}

/* Sum of products of two blocks of places. */
static double product(const float *restrict a, const float *restrict b) {
    double lanes[LANES] = {0};
    add_products(a, b, lanes);
    return total(lanes);
}

/* Return the element of rank `rank` of some numbers that are not negative, by their bits, the highest first. */
static float ranked(const float *at, int64_t count, int64_t rank) {
    static const int shift[] = {21, 10, 0}, bits[] = {11, 11, 10};
    uint32_t found = 0, mask = 0;
    for (int step = 0; step < 3; step++) {
        int32_t counts[2048] = {0};
        const uint32_t low = (1u << bits[step]) - 1;
        for (int64_t i = 0; i < count; i++) {
            uint32_t word;
            memcpy(&word, at + i, sizeof word);
            counts[(word >> shift[step]) & low] += (word & mask) == found;
        }
        uint32_t bin = 0;
        while (rank >= counts[bin]) rank -= counts[bin++];
        found |= bin << shift[step];
        mask |= low << shift[step];
    }
    float value;
    memcpy(&value, &found, sizeof value);
    return value;
}

/* Solve the symmetric system (n, n) in place by elimination; `right` (n, m) becomes the solution. */
static void eliminate(double *matrix, double *right, int n, int m) {
    for (int k = 0; k < n; k++)
        for (int i = k + 1; i < n; i++) {
            const double factor = matrix[i * n + k] / matrix[k * n + k];
            for (int j = k; j < n; j++) matrix[i * n + j] -= factor * matrix[k * n + j];
            for (int j = 0; j < m; j++) right[i * m + j] -= factor * right[k * m + j];
        }
    for (int i = n - 1; i >= 0; i--)
        for (int c = 0; c < m; c++) {
            for (int j = i + 1; j < n; j++) right[i * m + c] -= matrix[i * n + j] * right[j * m + c];
            right[i * m + c] /= matrix[i * n + i];
        }
}

/* The same, damped by a share of each diagonal element. */
static void solve(double *matrix, double *right, int n, int m, double ridge) {
    for (int i = 0; i < n; i++) matrix[i * n + i] += ridge * (matrix[i * n + i] > 0 ? matrix[i * n + i] : 0) + 1e-12;
    eliminate(matrix, right, n, m);
}

/* Write the product of a (n, k) and b (k, m). */
static void multiply(const double *a, const double *b, double *to, int n, int k, int m) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++) {
            double sum = 0;
            for (int l = 0; l < k; l++) sum += a[i * k + l] * b[l * m + j];
            to[i * m + j] = sum;
        }
}

/* Write the rotation by a vector, rad. */
static void rotation_by(const double *turn, double *to) {
    const double angle2 = turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2], angle = sqrt(angle2);
    const double a = angle > 1e-4 ? sin(angle) / angle : 1 - angle2 / 6;
    const double half = angle > 1e-4 ? sin(angle / 2) / angle : 0.5 - angle2 / 48, b = 2 * half * half;
    const double x = turn[0], y = turn[1], z = turn[2];
    const double cross[9] = {0, -z, y, z, 0, -x, -y, x, 0};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            to[i * 3 + j] = (i == j) + a * cross[i * 3 + j] + b * (turn[i] * turn[j] - (i == j ? angle2 : 0));
}

/* The standard deviation of a disk's aperture, radii, of a sphere at a position. */
static float blur_of(const Task *t, const double *position, int64_t k) {
    double distance2 = 0;
    for (int c = 0; c < 3; c++) {
        const float to_centre = (float)(position[c] - (double)t->origin[(k * 3 + c) * t->origins]);
        distance2 += (double)to_centre * to_centre;
    }
    return t->blur_px * (t->pitch_mm[k] + t->pitch_rad[k] * (float)sqrt(distance2)) / t->radius_mm;
}

/* Render a block of places at one instant, added to the disk with the instant's share; as `sphere_view`. */
static void render(const Task *t, const Disk *to, const Sums *of, int64_t k, int64_t instant, int64_t from, int n) {
    const float share = t->shares[instant];
    double position[3], turned[9], turn_by[9], by[3];
    memcpy(position, of->position, sizeof position), memcpy(turned, of->rotation, sizeof turned);
    if (t->moved) {
        const double *moved = t->moved + k * 6, open = t->instant[instant];
        for (int c = 0; c < 3; c++) by[c] = open * moved[c], position[c] += open * moved[3 + c];
        rotation_by(by, turn_by);
        multiply(turn_by, of->rotation, turned, 3, 3, 3);
    }
    const float *d[3], *origin = t->origin + k * 3 * t->origins, *axes = t->axes + k * 6;
    float R[3][3], centre[3], radius = t->radius_mm;
    for (int c = 0; c < 3; c++) {
        centre[c] = (float)(position[c] - (double)origin[c * t->origins]);
        d[c] = t->direction + (k * 3 + c) * t->places + from;
        for (int b = 0; b < 3; b++) R[c][b] = (float)turned[c * 3 + b];
    }
    const float blur = blur_of(t, position, k);
    float nearest[BLOCK], q0[BLOCK], edge[BLOCK], out[3][BLOCK], sight_b[3][BLOCK], out_b[3][BLOCK];
    float shape[EDGE_COLUMNS][BLOCK], q[BLOCK], seen[BLOCK], at[BLOCK], depth[BLOCK], normal[3][BLOCK];
    float value[BLOCK], radial[BLOCK], flat[3][BLOCK], turn[3][BLOCK], hidden[BLOCK];
    int32_t cell[BLOCK];
    float(*to_centre)[BLOCK] = normal; /* not needed at the same time */
    for (int c = 0; c < 3; c++)
        for (int i = 0; i < n; i++)
            to_centre[c][i] = t->origins == 1 ? centre[c] : (float)(position[c] - (double)origin[c * t->origins + from + i]);
    INDEPENDENT
    for (int i = 0; i < n; i++) {
        const float x = to_centre[0][i], y = to_centre[1][i], z = to_centre[2][i];
        const float along = x * d[0][i] + y * d[1][i] + z * d[2][i];
        const float ax = along * d[0][i] - x, ay = along * d[1][i] - y, az = along * d[2][i] - z;
        nearest[i] = most(sqrtf(ax * ax + ay * ay + az * az), 1e-6f * radius);
        out[0][i] = ax / nearest[i];
        out[1][i] = ay / nearest[i];
        out[2][i] = az / nearest[i];
        q0[i] = nearest[i] / radius;
        edge[i] = (1.0f - 0.5f * blur * blur - q0[i]) / blur;
    }
    for (int b = 0; b < 3; b++)
        for (int i = 0; i < n; i++) {
            sight_b[b][i] = R[0][b] * d[0][i] + R[1][b] * d[1][i] + R[2][b] * d[2][i];
            out_b[b][i] = R[0][b] * out[0][i] + R[1][b] * out[1][i] + R[2][b] * out[2][i];
        }
    int within = 1, beyond = !t->unseen.rows; /* the limb's paint shows whether that of a place beyond is known */
    for (int i = 0; i < n; i++) within &= edge[i] >= t->edge_far, beyond &= edge[i] <= -t->edge_far;
    const int outer = from >= t->inner, columns = outer ? EDGE_COLUMNS : 4;
    const float *table = t->edge, edges = (float)(t->edges - 1);
    float found[EDGE_COLUMNS];
    const float per_edge = (float)(t->edges - 1) / (2.0f * t->edge_most);
    if (within && !outer) /* far from the limb nothing is cut off */
        for (int c = 0; c < columns; c++)
            for (int i = 0; i < n; i++) shape[c][i] = c == 0 || c == 3 ? 1.0f : 0.0f;
    else
        for (int i = 0; i < n; i++) {
            const float exact = (edge[i] + t->edge_most) * per_edge;
            const int32_t row = placed(exact, edges);
            const float up = least(most(exact - (float)row, 0.0f), 1.0f);
            const float *here = table + row * EDGE_COLUMNS;
            for (int c = 0; c < EDGE_COLUMNS; c++) found[c] = here[c] + up * (here[EDGE_COLUMNS + c] - here[c]);
            for (int c = 0; c < columns; c++) shape[c][i] = found[c];
        }
    for (int i = 0; i < n; i++) {
        q[i] = least(most(q0[i] - blur * shape[2][i], 0.0f), 1.0f);
        seen[i] = q[i] * (1.0f + blur * blur * shape[3][i]);
    }
    memset(value, 0, sizeof value), memset(radial, 0, sizeof radial), memset(hidden, 0, sizeof hidden);
    memset(flat, 0, sizeof flat), memset(turn, 0, sizeof turn);
    const int nodes = beyond ? 0 : outer ? NODES : 2; /* no paint shows far beyond the limb */
    const float each = 1.0f / (float)(outer ? NODES : 2), side = (float)t->paint.side;
    for (int node = 0; node < nodes; node++) {
        const float *moves = outer ? shape[4 + NODES + node] : shape[3], sign = node ? 1.0f : -1.0f;
        if (outer)
            for (int i = 0; i < n; i++) at[i] = seen[i] + seen[i] * (q0[i] + blur * shape[4 + node][i] - seen[i]);
        else
            for (int i = 0; i < n; i++) at[i] = seen[i] + sign * blur * sqrtf(shape[3][i]) * seen[i];
        INDEPENDENT
        for (int i = 0; i < n; i++) {
            at[i] = least(most(at[i], 0.0f), t->sine_most);
            depth[i] = sqrtf(1.0f - at[i] * at[i]);
            for (int b = 0; b < 3; b++) normal[b][i] = at[i] * out_b[b][i] - depth[i] * sight_b[b][i];
            cell[i] = octahedral_cell(normal[0][i], normal[1][i], normal[2][i], side);
        }
        float plane[4][BLOCK];
        look_up(t->paint.rows, cell, n, plane);
        INDEPENDENT
        for (int i = 0; i < n; i++) {
            const float x = normal[0][i], y = normal[1][i], z = normal[2][i];
            const float gx = plane[1][i], gy = plane[2][i], gz = plane[3][i];
            value[i] += each * (plane[0][i] + gx * x + gy * y + gz * z);
            const float over_out = gx * out_b[0][i] + gy * out_b[1][i] + gz * out_b[2][i];
            const float over_sight = gx * sight_b[0][i] + gy * sight_b[1][i] + gz * sight_b[2][i];
            radial[i] += each * moves[i] * (over_out + at[i] / depth[i] * over_sight);
            flat[0][i] += each * at[i] * gx;
            flat[1][i] += each * at[i] * gy;
            flat[2][i] += each * at[i] * gz;
            turn[0][i] += each * (gy * z - gz * y);
            turn[1][i] += each * (gz * x - gx * z);
            turn[2][i] += each * (gx * y - gy * x);
        }
        if (t->unseen.rows) {
            const float unseen_side = (float)t->unseen.side;
            if (t->unseen.side != t->paint.side) {
                INDEPENDENT
                for (int i = 0; i < n; i++)
                    cell[i] = octahedral_cell(normal[0][i], normal[1][i], normal[2][i], unseen_side);
            }
            look_up(t->unseen.rows, cell, n, plane);
            INDEPENDENT
            for (int i = 0; i < n; i++) {
                const float x = normal[0][i], y = normal[1][i], z = normal[2][i];
                hidden[i] = most(hidden[i], plane[0][i] + plane[1][i] * x + plane[2][i] * y + plane[3][i] * z);
            }
        }
    }
    const float limb = share / (blur * radius), least_cover = t->cover_least;
    const int whole = t->instants == 1;
    float counts[BLOCK];
    /* Paint counts as far as the sphere covers the pixel; at one instant all of it. */
    for (int i = 0; i < n; i++) counts[i] = whole ? 1.0f : share * (shape[0][i] + least_cover);
    float *count = to->count + from, *cover = to->cover + from, *paint = to->paint + from, *aside = to->aside + from;
    float *x = to->x + from, *y = to->y + from;
    INDEPENDENT
    for (int i = 0; i < n; i++) {
        const float at_q = counts[i] * q[i];
        count[i] += counts[i];
        cover[i] += share * shape[0][i];
        paint[i] += counts[i] * value[i];
        aside[i] += at_q;
        x[i] += at_q * (axes[0] * out[0][i] + axes[1] * out[1][i] + axes[2] * out[2][i]);
        y[i] += at_q * (axes[3] * out[0][i] + axes[4] * out[1][i] + axes[5] * out[2][i]);
    }
    if (t->unseen.rows)
        for (int i = 0; i < n; i++) to->known[from + i] &= hidden[i] < t->unseen_most;
    /* Derivatives: across the radius a look-up stays at its share of it. */
    float *by_sight = value, *by_out = at;
    for (int i = 0; i < n; i++) {
        by_sight[i] = flat[0][i] * sight_b[0][i] + flat[1][i] * sight_b[1][i] + flat[2][i] * sight_b[2][i];
        by_out[i] = flat[0][i] * out_b[0][i] + flat[1][i] * out_b[1][i] + flat[2][i] * out_b[2][i];
    }
    for (int c = 0; c < 3; c++) {
        float *outward = to->out[c] + from, *turns = to->turn[c] + from, *moves = to->move[c] + from;
        float *limbs = to->limb[c] + from;
        const float *there = d[c], *beside = out[c], r0 = R[c][0], r1 = R[c][1], r2 = R[c][2];
        INDEPENDENT
        for (int i = 0; i < n; i++) {
            const float level = r0 * flat[0][i] + r1 * flat[1][i] + r2 * flat[2][i];
            const float across = level - by_sight[i] * there[i] - by_out[i] * beside[i];
            outward[i] += counts[i] * beside[i];
            turns[i] += counts[i] * (r0 * turn[0][i] + r1 * turn[1][i] + r2 * turn[2][i]);
            moves[i] -= counts[i] * (across / nearest[i] + radial[i] / radius * beside[i]);
            limbs[i] += shape[1][i] * limb * beside[i];
        }
    }
}

/* Divide sums over instants by what counted. */
static void mean_of_instants(const Task *t, const Disk *at) {
    for (int64_t p = 0; p < t->places; p++) {
        const float share = 1.0f / at->count[p];
        at->paint[p] *= share, at->aside[p] *= share, at->x[p] *= share, at->y[p] *= share;
        float length2 = 0;
        for (int c = 0; c < 3; c++) {
            at->turn[c][p] *= share, at->move[c][p] *= share;
            length2 += at->out[c][p] * at->out[c][p];
        }
        const float length = most(sqrtf(length2), 1e-12f);
        for (int c = 0; c < 3; c++) at->out[c][p] /= length;
    }
}

/* Look up light on the disk of a camera, as lights/disk.py. */
static void shine_on_disk(const Task *t, const Disk *at, int64_t k) {
    const float side = (float)t->light_side, half = 0.5f * side, *x = at->x, *y = at->y;
    const float *own = t->light + 2 * (k % t->cameras) * t->light_side * t->light_side;
    float *difference = at->difference, *black = at->black;
    INDEPENDENT
    for (int64_t p = 0; p < t->places; p++) {
        const int32_t column = placed((x[p] + 1.0f) * half, side), row = placed((y[p] + 1.0f) * half, side);
        const float *found = own + 2 * (row * (int32_t)t->light_side + column);
        difference[p] = found[0];
        black[p] = found[1];
    }
}

/* Look up light in the lab, as lights/lab.py. */
static void shine_in_lab(const Task *t, const Disk *at, int64_t k) {
    const float side = (float)t->light_side, gain = t->gain[k % t->cameras], depths = (float)t->depths;
    int32_t normal[BLOCK], mirror[BLOCK], deep[BLOCK];
    for (int64_t from = 0; from < t->places; from += BLOCK) {
        const int n = (int)(t->places - from < BLOCK ? t->places - from : BLOCK);
        const float *dx = t->direction + k * 3 * t->places + from, *dy = dx + t->places, *dz = dy + t->places;
        const float *x = at->out[0] + from, *y = at->out[1] + from, *z = at->out[2] + from, *aside = at->aside + from;
        float *difference = at->difference + from, *black = at->black + from;
        INDEPENDENT
        for (int i = 0; i < n; i++) {
            const float q = aside[i], depth = sqrtf(most(1.0f - q * q, 0.0f));
            const float nx = q * x[i] - depth * dx[i], ny = q * y[i] - depth * dy[i], nz = q * z[i] - depth * dz[i];
            const float mx = dx[i] + 2.0f * depth * nx, my = dy[i] + 2.0f * depth * ny, mz = dz[i] + 2.0f * depth * nz;
            normal[i] = octahedral_cell(nx, ny, nz, side);
            mirror[i] = octahedral_cell(mx, my, mz, side);
            deep[i] = placed(depth * depths, depths);
        }
        for (int i = 0; i < n; i++) {
            const float *scattered = t->light + 3 * normal[i], *cover = t->cover + 2 * deep[i];
            difference[i] = gain * cover[0] * scattered[0];
            black[i] = gain * (cover[0] * scattered[1] + cover[1] * t->light[3 * mirror[i] + 2]);
        }
    }
}

/* Look up the learnt light, by its kind, and what the picture shows beside the sphere. */
static void shine(const Task *t, const Disk *at, int64_t k) {
    static void (*const kinds[])(const Task *, const Disk *, int64_t) = {shine_on_disk, shine_in_lab};
    kinds[t->light_kind](t, at, k);
    const float *stray = t->stray + (k % t->cameras) * HARMONICS, *x = at->x, *y = at->y;
    memcpy(at->beside, t->behind + k * t->places, sizeof(float) * (size_t)t->places);
    int none = 1;
    for (int h = 0; h < HARMONICS; h++) none &= stray[h] == 0.0f;
    for (int64_t p = none ? t->places : t->inner; p < t->places; p++) {
        const float length = most(sqrtf(x[p] * x[p] + y[p] * y[p]), 1e-12f);
        const float cosine = x[p] / length, sine = y[p] / length;
        float c = cosine, s = sine, sum = stray[0];
        for (int h = 1; h < HARMONICS; h += 2) {
            sum += stray[h] * c + stray[h + 1] * s;
            const float next = c * cosine - s * sine;
            s = s * cosine + c * sine;
            c = next;
        }
        at->beside[p] += sum;
    }
}

static inline float noise_variance(const float *noise, float grey, float floor_) {
    grey = most(grey, 0.0f);
    return most(noise[0] + grey * (noise[1] + grey * (noise[2] + grey * noise[3])), floor_);
}

/* Write the first `count` monomials of a block, and those of the same order: 1, x, y, x^2, xy, y^2 .. */
static void monomials(const float *x, const float *y, int n, int64_t count, float to[TINTS][BLOCK]) {
    for (int i = 0; i < n; i++) to[0][i] = 1.0f;
    for (int order = 1, last = 0, next = 1; next < count; order++) {
        for (int c = 0; c <= order; c++) {
            const float *from = to[last + (c ? c - 1 : 0)], *by = c ? y : x;
            for (int i = 0; i < n; i++) to[next + c][i] = from[i] * by[i];
        }
        last = next;
        next += order + 1;
    }
}

/* Write what each coefficient of the frame's own light adds in a block; places beyond n become 0. */
static void lit_columns(const Task *t, const Disk *at, int64_t from, int n, float tints[TINTS][BLOCK],
                       float to[][BLOCK]) {
    const int64_t more = t->n_difference > t->n_black ? t->n_difference : t->n_black;
    monomials(at->x + from, at->y + from, n, more, tints);
    const float *cover = at->cover + from, *paint = at->paint + from;
    const float *difference = at->difference + from, *black = at->black + from;
    float learnt[BLOCK];
    for (int i = 0; i < n; i++) learnt[i] = cover[i] * (paint[i] * difference[i] + black[i]);
    for (int c = 0; c < t->n_difference; c++)
        for (int i = 0; i < n; i++) to[c][i] = learnt[i] * tints[c][i];
    for (int c = 0; c < t->n_black; c++)
        for (int i = 0; i < n; i++) to[t->n_difference + c][i] = cover[i] * tints[c][i];
    const int count = (int)(t->n_difference + t->n_black);
    for (int c = 0; c < count; c++)
        for (int i = n; i < BLOCK; i++) to[c][i] = 0.0f;
}

/* Move the paint towards the light, as `leaning`. */
static void lean(const Task *t, const Disk *at, const Sums *of, int64_t k) {
    const float *slope = t->lean + (k % t->cameras) * 2 * SLOPES, *axes = t->axes + k * 6;
    const float blur = blur_of(t, of->position, k), by = t->radius_mm * blur * blur;
    float powers[TINTS][BLOCK];
    for (int64_t from = 0; from < t->places; from += BLOCK) {
        const int n = (int)(t->places - from < BLOCK ? t->places - from : BLOCK);
        float across[2][BLOCK] = {0}, *paint = at->paint + from;
        monomials(at->x + from, at->y + from, n, SLOPES, powers);
        for (int s = 0; s < SLOPES; s++)
            for (int i = 0; i < n; i++) {
                across[0][i] += slope[s] * powers[s][i];
                across[1][i] += slope[SLOPES + s] * powers[s][i];
            }
        for (int c = 0; c < 3; c++) {
            const float *move = at->move[c] + from;
            INDEPENDENT
            for (int i = 0; i < n; i++) paint[i] -= by * (axes[c] * across[0][i] + axes[3 + c] * across[1][i]) * move[i];
        }
    }
}

/* Find the frame's own light, residuals, and weights by an expected picture and weights, as `residuals`. */
static float light_up(const Task *t, const Disk *at, const Sums *of, int64_t k, double *coefficients) {
    const int64_t P = t->places;
    const float *grey = t->grey + k * P, *noise = t->noise + (k % t->cameras) * 4, floor_ = t->noise_least;
    const float own[4] = {noise[0], noise[1], noise[2], noise[3]};
    const uint8_t *inside = at->counts, *clipped = t->clipped + k * P;
    float *expected = of->expected, *weight = of->weight;
    float tints[TINTS][BLOCK], column[COLUMNS][BLOCK], weighted[BLOCK], target[BLOCK];
    double matrix[COLUMNS * COLUMNS], (*sums)[LANES] = at->sums;
    const int count = (int)(t->n_difference + t->n_black);
    memset(sums, 0, sizeof(double) * LANES * (size_t)(count * (count + 3) / 2));
    for (int64_t from = 0; from < P; from += BLOCK) {
        const int n = (int)(P - from < BLOCK ? P - from : BLOCK);
        lit_columns(t, at, from, n, tints, column);
        for (int i = 0; i < n; i++) target[i] = grey[from + i] - (1.0f - at->cover[from + i]) * at->beside[from + i];
        for (int i = n; i < BLOCK; i++) target[i] = weighted[i] = 0.0f;
        float factor[BLOCK];
        for (int i = 0; i < n; i++)
            factor[i] = weight[from + i] / noise_variance(own, expected[from + i], floor_);
        for (int a = 0, next = 0; a < count; a++) {
            for (int i = 0; i < n; i++) weighted[i] = factor[i] * column[a][i];
            for (int b = a; b < count; b++) add_products(weighted, column[b], sums[next++]);
            add_products(weighted, target, sums[next++]);
        }
    }
    for (int a = 0, next = 0; a < count; a++) {
        for (int b = a; b < count; b++) matrix[a * count + b] = matrix[b * count + a] = total(sums[next++]);
        coefficients[a] = total(sums[next++]);
    }
    solve(matrix, coefficients, count, 1, 1e-7);
    float by[COLUMNS];
    for (int c = 0; c < count; c++) by[c] = (float)coefficients[c];
    int64_t finite = 0;
    for (int64_t from = 0; from < P; from += BLOCK) {
        const int n = (int)(P - from < BLOCK ? P - from : BLOCK);
        lit_columns(t, at, from, n, tints, column);
        float painted[BLOCK] = {0};
        for (int c = 0; c < count; c++)
            for (int i = 0; i < n; i++) painted[i] += by[c] * column[c][i];
        float *residual = at->residual + from, *variance = at->variance + from, *wanted = expected + from;
        const float *cover = at->cover + from, *beside = at->beside + from, *seen = grey + from;
        INDEPENDENT
        for (int i = 0; i < n; i++) {
            const float beyond = (1.0f - cover[i]) * beside[i];
            wanted[i] = painted[i] + beyond;
            residual[i] = seen[i] - beyond - painted[i];
            variance[i] = noise_variance(own, wanted[i], floor_);
        }
        /* A saturated pixel shows only that its grey level is at least this one. */
        for (int i = 0; i < n; i++) {
            const int silent = clipped[from + i] & (residual[i] <= 0.0f);
            residual[i] = silent ? 0.0f : residual[i];
            weight[from + i] = (float)(inside[from + i] & !silent);
        }
    }
    for (int64_t p = 0; p < P; p += EVERY)
        if (inside[p]) {
            const float square = at->residual[p] * at->residual[p] / at->variance[p];
            if (square == square) at->sorted[finite++] = square;
        }
    const float deviation = finite ? 1.4826f * sqrtf(ranked(at->sorted, finite, (finite - 1) / 2)) : 0.0f;
    const float scale = most(deviation, 1.0f) * most(deviation, 1.0f);
    float *variance = at->variance;
    const float *residual = at->residual, limit = t->tukey2;
    INDEPENDENT
    for (int64_t p = 0; p < P; p++) {
        variance[p] *= scale;
        const float near = most(1.0f - residual[p] * residual[p] / (limit * variance[p]), 0.0f);
        weight[p] *= near * near;
    }
    return deviation;
}

/* Sum the normal equations of pose and light, and where asked for the scores of tiles. */
static void gather(const Task *t, const Disk *at, Sums *of) {
    const int64_t P = t->places, nd = t->n_difference;
    const int n_all = 6 + (int)(nd + t->n_black);
    const float *weight = of->weight;
    double *normal = of->normal, *gradient = of->gradient, *scores = of->scores, *coefficients = of->coefficients;
    float tints[TINTS][BLOCK], column[COLUMNS][BLOCK], weighted[BLOCK], precision[BLOCK], left[BLOCK];
    float score[BLOCK][COLUMNS];
    double(*sums)[LANES] = at->sums;
    memset(sums, 0, sizeof(double) * LANES * (size_t)(n_all * (n_all + 3) / 2));
    if (of->last) memset(scores, 0, sizeof(double) * (size_t)(n_all * t->tiles));
    for (int64_t from = 0; from < P; from += BLOCK) {
        const int n = (int)(P - from < BLOCK ? P - from : BLOCK);
        lit_columns(t, at, from, n, tints, column + 6);
        float gain[BLOCK] = {0}, offset[BLOCK] = {0};
        for (int c = 0; c < nd; c++) {
            const float by = (float)coefficients[c];
            for (int i = 0; i < n; i++) gain[i] += by * tints[c][i];
        }
        for (int c = 0; c < t->n_black; c++) {
            const float by = (float)coefficients[nd + c];
            for (int i = 0; i < n; i++) offset[i] += by * tints[c][i];
        }
        float *lit = at->lit + from, over[BLOCK];
        const float *difference = at->difference + from, *black = at->black + from, *beside = at->beside + from;
        const float *cover = at->cover + from, *paint = at->paint + from, *variance = at->variance + from;
        INDEPENDENT
        for (int i = 0; i < n; i++) {
            const float step = difference[i] * gain[i];
            lit[i] = cover[i] * step;
            over[i] = paint[i] * step + black[i] * gain[i] + offset[i] - beside[i];
            precision[i] = weight[from + i] / variance[i];
        }
        memcpy(left, at->residual + from, sizeof(float) * (size_t)n);
        for (int c = 0; c < 3; c++) {
            const float *turn = at->turn[c] + from, *move = at->move[c] + from, *limb = at->limb[c] + from;
            for (int i = 0; i < n; i++) column[c][i] = lit[i] * turn[i];
            for (int i = 0; i < n; i++) column[3 + c][i] = lit[i] * move[i] + over[i] * limb[i];
        }
        for (int i = n; i < BLOCK; i++) {
            left[i] = weighted[i] = 0.0f;
            for (int c = 0; c < 6; c++) column[c][i] = 0.0f;
        }
        for (int a = 0, next = 0; a < n_all; a++) {
            for (int i = 0; i < n; i++) weighted[i] = precision[i] * column[a][i];
            for (int b = a; b < n_all; b++) add_products(weighted, column[b], sums[next++]);
            add_products(weighted, left, sums[next++]);
            if (of->last)
                for (int i = 0; i < n; i++) score[i][a] = weighted[i] * left[i];
        }
        if (of->last)
            for (int i = 0; i < n; i++) {
                double *tile = scores + t->tile[from + i] * n_all;
                for (int a = 0; a < n_all; a++) tile[a] += score[i][a];
            }
    }
    for (int a = 0, next = 0; a < n_all; a++) {
        for (int b = a; b < n_all; b++) normal[a * n_all + b] = normal[b * n_all + a] = total(sums[next++]);
        gradient[a] = total(sums[next++]);
    }
}

/* Fit a disk of smooth grey levels to every fourth place; return how much better the painted sphere explains them than
   that does, or the empty scene, as `scores_of`. */
static double score_of(const Task *t, const Disk *at, int64_t k) {
    const int64_t P = t->places;
    const float *seen = t->grey + k * P;
    const uint8_t *clipped = t->clipped + k * P;
    double matrix[TINTS * TINTS], smooth[TINTS], (*sums)[LANES] = at->sums;
    double cover = 0, share = 0, some = 0, mean = 0, spread = 0, left[3] = {0};
    float tints[TINTS][BLOCK], weighted[BLOCK], by[TINTS];
    float covered[BLOCK], counted[BLOCK], grey[BLOCK], disk[BLOCK], beside[BLOCK], residual[BLOCK], x[BLOCK], y[BLOCK];
    uint8_t full[BLOCK];
    memset(sums, 0, sizeof(double) * LANES * (TINTS * (TINTS + 3) / 2));
    for (int64_t p = 0; p < P; p++) cover += at->cover[p], share += at->counts[p] ? at->cover[p] : 0.0f;
    for (int pass = 0; pass < 3; pass++) { /* each needs the sums of the one before */
        for (int64_t from = 0; from < P; from += EVERY * BLOCK) {
            const int64_t rest = (P - from + EVERY - 1) / EVERY;
            const int n = (int)(rest < BLOCK ? rest : BLOCK);
            for (int i = 0; i < BLOCK; i++) full[i] = 0, covered[i] = counted[i] = grey[i] = disk[i] = beside[i] = residual[i] = x[i] = y[i] = 0;
            for (int i = 0; i < n; i++) {
                const int64_t p = from + EVERY * i;
                covered[i] = at->cover[p], counted[i] = at->counts[p] ? at->cover[p] : 0.0f, residual[i] = at->residual[p];
                grey[i] = seen[p], full[i] = clipped[p], beside[i] = at->beside[p], x[i] = at->x[p], y[i] = at->y[p];
                disk[i] = grey[i] - (1.0f - covered[i]) * beside[i];
            }
            if (pass != 1) {
                monomials(x, y, BLOCK, TINTS, tints);
                for (int a = 0; a < TINTS; a++)
                    for (int i = 0; i < BLOCK; i++) tints[a][i] *= covered[i];
            }
            if (pass == 0) {
                for (int i = 0; i < BLOCK; i++) some += counted[i], mean += counted[i] * grey[i];
                for (int a = 0, next = 0; a < TINTS; a++) {
                    for (int i = 0; i < BLOCK; i++) weighted[i] = counted[i] * tints[a][i];
                    for (int b = a; b < TINTS; b++) add_products(weighted, tints[b], sums[next++]);
                    add_products(weighted, disk, sums[next++]);
                }
            } else if (pass == 1) {
                for (int i = 0; i < BLOCK; i++) spread += counted[i] * (grey[i] - mean) * (grey[i] - mean);
            } else {
                const float limit = (float)(t->outliers * spread);
                for (int a = 0; a < TINTS; a++)
                    for (int i = 0; i < BLOCK; i++) disk[i] -= by[a] * tints[a][i];
                for (int i = 0; i < BLOCK; i++) {
                    /* a saturated pixel shows only that its grey level is at least this one */
                    const float lowest = full[i] ? 0.0f : -FLT_MAX;
                    const float smoothly = most(disk[i], lowest), empty = most(grey[i] - beside[i], lowest);
                    left[0] += counted[i] * least(residual[i] * residual[i], limit);
                    left[1] += counted[i] * least(smoothly * smoothly, limit);
                    left[2] += counted[i] * least(empty * empty, limit);
                }
            }
        }
        some = some > 1e-6 ? some : 1e-6;
        if (pass == 1) spread /= some;
        if (pass) continue;
        mean /= some;
        for (int a = 0, next = 0; a < TINTS; a++) {
            for (int b = a; b < TINTS; b++) matrix[a * TINTS + b] = matrix[b * TINTS + a] = total(sums[next++]);
            smooth[a] = total(sums[next++]);
        }
        solve(matrix, smooth, TINTS, 1, 1e-7);
        for (int a = 0; a < TINTS; a++) by[a] = (float)smooth[a];
    }
    if (!(spread > 1e-6 && share > t->known_least * cover)) return 0.0;
    const double other = (left[1] < left[2] ? left[1] : left[2]) / some, painted = left[0] / some;
    const double score = 1.0 - painted / (other > 1e-9 ? other : 1e-9);
    return score > -1.0 ? score : -1.0;
}

/* Tell how well the disk is explained: score, loss, median step from black to white paint. */
static void tell(const Task *t, const Disk *at, Sums *of, int64_t k, float deviation) {
    const int64_t P = t->places;
    const float scale = logf(most(deviation, 1.0f)), sixth = t->tukey2 / 6.0f, limit = t->tukey2;
    double *figures = of->figures, loss = 0;
    float part[BLOCK], all[BLOCK];
    for (int64_t from = 0; from < P; from += BLOCK) {
        const int n = (int)(P - from < BLOCK ? P - from : BLOCK);
        const float *residual = at->residual + from, *variance = at->variance + from;
        for (int i = 0; i < BLOCK; i++) part[i] = all[i] = 0.0f;
        for (int i = 0; i < n; i++) {
            const float near = most(1.0f - residual[i] * residual[i] / (limit * variance[i]), 0.0f);
            part[i] = sixth * (1.0f - near * near * near) + scale;
        }
        for (int i = 0; i < n; i++)
            if (!at->known[from + i]) part[i] = logf(most(at->lit[from + i] / sqrtf((float)TWO_PI * variance[i]), 1.0f));
        for (int i = 0; i < n; i++) all[i] = of->kept[from + i] ? 1.0f : 0.0f;
        loss += product(all, part);
    }
    figures[0] = score_of(t, at, k);
    figures[1] = loss;
    for (int64_t p = 0; p < t->inner; p++) at->sorted[p] = most(at->lit[p], 0.0f); /* below 1 all count alike */
    figures[3] = 0;
    for (int64_t p = 0; p < P; p++)
        if (of->weight[p] > 0.0f)
            figures[3] += sqrtf(at->limb[0][p] * at->limb[0][p] + at->limb[1][p] * at->limb[1][p] + at->limb[2][p] * at->limb[2][p]);
    figures[2] = t->inner ? ranked(at->sorted, t->inner, (t->inner - 1) / 2) : 0.0;
}

/* Eliminate the light's coefficients, from the scores as well. */
static void without_light(const Task *t, Sums *of) {
    const int light = (int)(t->n_difference + t->n_black), n = 6 + light;
    double own[COLUMNS * COLUMNS], mixed[COLUMNS * 6];
    for (int a = 0; a < light; a++) {
        for (int b = 0; b < light; b++) own[a * light + b] = of->normal[(6 + a) * n + 6 + b];
        own[a * light + a] += 1e-7 * (own[a * light + a] + 1e-12);
        for (int c = 0; c < 6; c++) mixed[a * 6 + c] = of->normal[(6 + a) * n + c];
    }
    eliminate(own, mixed, light, 6);
    for (int a = 0; a < 6; a++) {
        of->pull[a] = of->gradient[a];
        for (int l = 0; l < light; l++) of->pull[a] -= mixed[l * 6 + a] * of->gradient[6 + l];
        for (int b = 0; b < 6; b++) {
            double sum = of->normal[a * n + b];
            for (int l = 0; l < light; l++) sum -= of->normal[a * n + 6 + l] * mixed[l * 6 + b];
            of->information[a * 6 + b] = sum;
        }
    }
    for (int64_t tile = 0; of->last && tile < t->tiles; tile++)
        for (int a = 0; a < 6; a++)
            for (int l = 0; l < light; l++)
                of->scores[tile * n + a] -= of->scores[tile * n + 6 + l] * mixed[l * 6 + a];
}

/* Add the neighbours within `reach` along one axis of a grid, `stride` apart; or find the largest of them. */
static void along(const float *from, float *to, int64_t cells, int64_t stride, int64_t reach, int sum) {
    const int64_t edge = stride * reach;
    for (int64_t i = 0; i < cells; i++) to[i] = 0.0f;
    for (int64_t step = -edge; step <= edge; step += stride)
        if (sum)
            for (int64_t i = edge; i < cells - edge; i++) to[i] += from[i + step];
        else
            for (int64_t i = edge; i < cells - edge; i++) to[i] = most(to[i], from[i + step]);
}

/* Write the least and the size of the square about all places, with a margin on each side. */
static void square_about(const Task *t, Disk *at) {
    int64_t size[2];
    for (int c = 0; c < 2; c++) {
        const int64_t *place = t->place + c * t->places;
        int64_t low = t->places ? place[0] : 0, high = low;
        for (int64_t p = 0; p < t->places; p++) low = place[p] < low ? place[p] : low, high = place[p] > high ? place[p] : high;
        at->first[c] = low, size[c] = high - low + 1 + 2 * t->margin;
    }
    at->width = size[0], at->height = size[1];
}

/* Leave out the places that something before the sphere shows, as `occluded`: windows that differ, and their margin.
   Return whether there are any. */
static int uncover(const Task *t, const Disk *at, Sums *of, int64_t k) {
    const int64_t P = t->places, margin = t->margin;
    const float *grey = t->grey + k * P, *noise = t->noise + (k % t->cameras) * 4;
    const uint8_t *clipped = t->clipped + k * P;
    const int64_t width = at->width, height = at->height;
    const int64_t cells = width * height, origin = (margin - at->first[1]) * width + margin - at->first[0];
    const int64_t *right = t->place, *down = t->place + P;
    float *squares = at->lit, *differs = at->grid[0], *counted = at->grid[1], *work = at->grid[2];
    int64_t finite = 0, all = 0, hidden = 0;
    const float own[4] = {noise[0], noise[1], noise[2], noise[3]}, floor_ = t->noise_least, *expected = of->expected;
    INDEPENDENT
    for (int64_t p = 0; p < P; p++) {
        const float residual = grey[p] - expected[p];
        squares[p] = residual * residual / noise_variance(own, expected[p], floor_);
    }
    for (int64_t p = 0; p < P; p += EVERY)
        if (at->counts[p] && !clipped[p] && squares[p] == squares[p]) at->sorted[finite++] = squares[p];
    const float deviation = finite ? 1.4826f * sqrtf(ranked(at->sorted, finite, (finite - 1) / 2)) : 0.0f;
    const float scale = most(deviation, 1.0f) * most(deviation, 1.0f);
    memset(differs, 0, sizeof(float) * (size_t)cells), memset(counted, 0, sizeof(float) * (size_t)cells);
    for (int64_t p = 0; p < P; p++)
        if (at->counts[p] && !clipped[p]) {
            const int64_t cell = origin + down[p] * width + right[p];
            differs[cell] = least(squares[p] / scale, t->most_each);
            counted[cell] = 1.0f;
        }
    for (int g = 0; g < 2; g++) {
        along(at->grid[g], work, cells, 1, t->window, 1);
        along(work, at->grid[g], cells, width, t->window, 1);
    }
    float *seeds = at->grid[3];
    memset(seeds, 0, sizeof(float) * (size_t)cells);
    int any = 0;
    for (int64_t row = margin; row < height - margin; row++)
        for (int64_t i = row * width + margin; i < (row + 1) * width - margin; i++) {
            const int seed = differs[i] > t->covered * most(counted[i], t->least_of_window);
            seeds[i] = (float)seed;
            any |= seed;
        }
    if (!any) return 0;
    along(seeds, work, cells, 1, margin, 0);
    along(work, seeds, cells, width, margin, 0);
    for (int64_t p = 0; p < P; p++) {
        const int counts = at->counts[p] && !clipped[p];
        all += counts;
        hidden += counts && seeds[origin + down[p] * width + right[p]] > 0.0f;
    }
    if ((float)hidden > t->most_hidden * (float)(all ? all : 1)) return 0;
    for (int64_t p = 0; p < P; p++)
        if (seeds[origin + down[p] * width + right[p]] > 0.0f) of->kept[p] = 0;
    return 1;
}

/* Sum the linear problem of one disk. */
static void sum_disk(const Task *t, const Disk *at, Sums *of, int64_t k) {
    const int64_t padded = (t->places + BLOCK - 1) / BLOCK * BLOCK;
    memset(at->paint, 0, sizeof(float) * (size_t)(padded * 18)); /* the first of its arrays, up to `count` */
    memset(at->known, 1, (size_t)padded);
    for (int64_t instant = 0; instant < t->instants; instant++)
        for (int64_t from = 0, n; from < t->places; from += n) {
            const int64_t end = from < t->inner ? t->inner : t->places; /* a block lies on one side of `inner` */
            n = end - from < BLOCK ? end - from : BLOCK;
            render(t, at, of, k, instant, from, (int)n);
        }
    if (t->instants > 1) mean_of_instants(t, at);
    if (t->lean) lean(t, at, of, k);
    shine(t, at, k);
    const float dark = t->dark[k % t->cameras];
    for (int64_t p = 0; p < t->places; p++) /* a limb in shadow does not count */
        at->known[p] &= at->difference[p] >= dark || at->cover[p] >= t->in_sight;
    const uint8_t *clipped = t->clipped + k * t->places;
    for (int seek = of->first && t->most_hidden > 0; seek >= 0; seek--) { /* without occluders, anew */
        for (int64_t p = 0; p < t->places; p++) at->counts[p] = of->kept[p] && at->known[p];
        if (of->first) { /* the first weights come from the picture itself, bubbles included; a second round does without */
            memcpy(of->expected, t->grey + k * t->places, sizeof(float) * (size_t)t->places);
            for (int64_t p = 0; p < t->places; p++) of->weight[p] = (float)(at->counts[p] && !clipped[p]);
        }
        for (int round = 0; round < (of->first ? 2 : 1); round++) of->deviation = light_up(t, at, of, k, of->coefficients);
        if (seek && !uncover(t, at, of, k)) seek = 0; /* all is as before: once is enough */
        if (!t->iterations) return;
    }
    gather(t, at, of);
    if (of->last) tell(t, at, of, k, (float)of->deviation);
    without_light(t, of);
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static double length(const double *a) { return sqrt(dot(a, a)); }

/* Shorten a step by the largest change that a camera of `seen` sees, as `_bounded`. */
static void bound(double *step, const Sums *sums, const uint8_t *seen, int64_t cameras, double radius) {
    double size = length(step);
    for (int64_t c = 0; c < cameras; c++) {
        const double *to_centre = sums[c].to_centre, norm = length(to_centre), distance = norm > radius ? norm : radius;
        double along = 0, aside[3];
        for (int i = 0; i < 3; i++) along += step[3 + i] * to_centre[i] / distance;
        for (int i = 0; i < 3; i++) aside[i] = step[3 + i] - along * to_centre[i] / distance;
        const double change = (!seen || seen[c]) * hypot(length(aside) / radius, along / distance);
        size = change > size || change != change ? change : size;
    }
    const double shorter = 0.1 / (size < 0.1 ? 0.1 : size);
    for (int i = 0; i < 6; i++) step[i] *= shorter;
}

static void invert(const double *matrix, double *inverse, int n) {
    double work[36];
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) work[i * n + j] = matrix[i * n + j], inverse[i * n + j] = i == j;
    solve(work, inverse, n, n, 1e-9);
}

/* Write a b a' of symmetric a and b, (n, n). */
static void sandwich(const double *a, const double *b, double *to, int n) {
    double half[36];
    multiply(a, b, half, n, n, n);
    multiply(half, a, to, n, n, n);
}

static double trace(const double *matrix, int n) {
    double sum = 0;
    for (int i = 0; i < n; i++) sum += matrix[i * n + i];
    return sum;
}

/* The area that a place stands for, px: places are in order of distance. */
static double place_px2(const Task *t) {
    if (!t->places) return 0;
    const double right = (double)t->place[t->places - 1], down = (double)t->place[2 * t->places - 1];
    return 0.5 * TWO_PI * (right * right + down * down) / (double)t->places;
}

/* Tell the covariance of a pose, and what each camera alone says. `whole` is the information of all, `step` the last. */
static void conclude(const Task *t, const Sums *sums, int64_t pose, const double *whole, const double *step) {
    const int64_t cameras = t->cameras, n_all = 6 + t->n_difference + t->n_black;
    const uint8_t *use = t->use + pose * cameras;
    const double radius = t->radius_mm, count = (double)t->tiles, fitted = (double)n_all;
    const double few = count / (count - fitted > 1 ? count - fitted : 1);
    double meat[36] = {0}, bread[36], lured[36] = {0}, found[6] = {0}, aside_px = 0, finest_mm = INFINITY, nll = 0;
    invert(whole, bread, 6);
    for (int64_t c = 0; c < cameras; c++) {
        const Sums *of = sums + c;
        const int64_t k = pose * cameras + c;
        const double *information = of->information, *to_centre = of->to_centre, distance = length(to_centre);
        double shared[36] = {0}, corner[9], own_bread[9], own[36], freely[36], right[6];
        for (int64_t tile = 0; tile < t->tiles; tile++)
            for (int a = 0; a < 6; a++)
                for (int b = 0; b < 6; b++)
                    shared[a * 6 + b] += of->scores[tile * n_all + a] * of->scores[tile * n_all + b];
        for (int i = 0; i < 36; i++) shared[i] *= few;
        for (int a = 0; a < 3; a++)
            for (int b = 0; b < 3; b++) corner[a * 3 + b] = information[a * 6 + b];
        for (int a = 0; a < 3; a++) {
            right[a] = of->pull[a];
            for (int b = 0; b < 3; b++) right[a] -= information[a * 6 + 3 + b] * step[3 + b];
        }
        invert(corner, own_bread, 3);
        memcpy(own, corner, sizeof corner);
        solve(own, right, 3, 1, 1e-9);
        for (int a = 0; a < 3; a++) t->own_turn[k * 3 + a] = right[a] - step[a];
        for (int a = 0; a < 3; a++)
            for (int b = 0; b < 3; b++) corner[a * 3 + b] = shared[a * 6 + b];
        double *own_covariance = t->own_covariance + k * 9;
        sandwich(own_bread, corner, own_covariance, 3);
        const double noise = trace(own_bread, 3);
        t->excess[k] = sqrt(trace(own_covariance, 3) / (noise > 1e-30 ? noise : 1e-30));
        invert(information, freely, 6);
        multiply(freely, of->pull, right, 6, 6, 1);
        for (int i = 0; i < 6; i++) right[i] -= step[i];
        bound(right, of, 0, 1, radius);
        memcpy(t->own_move + k * 3, right + 3, sizeof(double) * 3);
        sandwich(freely, shared, own, 6);
        double across = own[21] + own[28] + own[35];
        for (int a = 0; a < 3; a++)
            for (int b = 0; b < 3; b++)
                across -= to_centre[a] * own[(3 + a) * 6 + 3 + b] * to_centre[b] / (distance * distance);
        t->own_sigma[k] = sqrt((across > 0 ? across : 0) / 2);
        t->score[k] = of->figures[0];
        const double px_mm = (double)t->pitch_mm[k] + (double)t->pitch_rad[k] * distance;
        const double angle = 1 - radius * radius / (distance * distance);
        const double limb = place_px2(t) * of->figures[3] * px_mm * px_mm * angle * angle / (TWO_PI * radius);
        t->limb_coverage[k] = limb > 1 ? 1 : limb;
        if (!use[c]) continue;
        nll += of->figures[1];
        /* An edge that is a pixel off moves the sphere along each line of sight. */
        double edge[6], moved[6];
        for (int a = 0; a < 6; a++) {
            edge[a] = 0;
            for (int b = 0; b < 3; b++) edge[a] += information[a * 6 + 3 + b] * to_centre[b] * (px_mm / radius);
        }
        multiply(bread, edge, moved, 6, 6, 1);
        for (int a = 0; a < 6; a++) {
            found[a] += t->limb_px ? (double)t->limb_px[c] * moved[a] : 0;
            for (int b = 0; b < 6; b++) lured[a * 6 + b] += moved[a] * moved[b];
        }
        for (int i = 0; i < 36; i++) meat[i] += shared[i];
        const float *stray = t->stray + c * HARMONICS;
        double square = (double)stray[0] * stray[0];
        for (int h = 1; h < HARMONICS; h++) square += 0.5 * stray[h] * stray[h];
        const double moved_px = t->blur_px * sqrt(square) / (of->figures[2] > 1 ? of->figures[2] : 1);
        aside_px = moved_px > aside_px ? moved_px : aside_px;
        finest_mm = px_mm < finest_mm ? px_mm : finest_mm;
    }
    t->nll[pose] = nll;
    int any_seen = 1;
    for (int i = 0; i < 6; i++) any_seen &= whole[i * 7] > 0;
    double *covariance = t->covariance + pose * 36, sum[36];
    memcpy(covariance, bread, sizeof bread); /* without a picture */
    if (!any_seen) return;
    if (t->place_precision) /* the prior position has an error of its own */
        for (int a = 0; a < 3; a++)
            for (int b = 0; b < 3; b++) meat[(3 + a) * 6 + 3 + b] += t->place_precision[pose * 9 + a * 3 + b];
    sandwich(bread, meat, sum, 6);
    const double edge2 = (double)t->edge_px * (double)t->edge_px, aside_mm = finest_mm < INFINITY ? aside_px * finest_mm : 0;
    for (int a = 0; a < 6; a++)
        for (int b = 0; b < 6; b++) sum[a * 6 + b] += edge2 * lured[a * 6 + b] + found[a] * found[b];
    for (int a = 0; a < 6; a++) sum[a * 7] += (a < 3 ? aside_mm / radius : aside_mm) * (a < 3 ? aside_mm / radius : aside_mm);
    for (int a = 0; a < 6; a++)
        for (int b = 0; b < 6; b++) covariance[a * 6 + b] = 0.5 * (sum[a * 6 + b] + sum[b * 6 + a]);
}

/* Fit one pose to the pictures of all cameras. */
static void fit(const Task *t, const Disk *at, Sums *sums, int64_t pose) {
    const int64_t cameras = t->cameras;
    const uint8_t *use = t->use + pose * cameras;
    const double *start = t->start + pose * 3, *prior = t->place_precision ? t->place_precision + pose * 9 : 0;
    double X[3], R[9], whole[36], step[6];
    memcpy(X, start, sizeof X), memcpy(R, t->start_rotation + pose * 9, sizeof R);
    for (int64_t c = 0; c < cameras; c++) {
        const int64_t k = (pose * cameras + c) * t->places;
        sums[c].kept = t->kept + k;
        memcpy(t->kept + k, t->inside + k, (size_t)t->places);
    }
    for (int64_t round = 0; round < (t->iterations ? t->iterations : 1); round++) {
        memset(whole, 0, sizeof whole), memset(step, 0, sizeof step);
        for (int64_t c = 0; c < cameras; c++) {
            const int64_t k = pose * cameras + c;
            Sums *of = sums + c;
            of->position = X, of->rotation = R;
            of->first = round == 0, of->last = !t->passing && round == t->iterations - 1;
            sum_disk(t, at, of, k);
            for (int i = 0; i < 3; i++) of->to_centre[i] = X[i] - (double)t->origin[(k * 3 + i) * t->origins];
            if (!use[c] || !t->iterations) continue;
            for (int i = 0; i < 36; i++) whole[i] += of->information[i];
            for (int i = 0; i < 6; i++) step[i] += of->pull[i];
        }
        if (!t->iterations) return;
        for (int a = 0; a < 3 && prior; a++)
            for (int b = 0; b < 3; b++) {
                whole[(3 + a) * 6 + 3 + b] += prior[a * 3 + b];
                step[3 + a] -= prior[a * 3 + b] * (X[b] - start[b]);
            }
        double work[36], by[9], turned[9];
        memcpy(work, whole, sizeof work);
        solve(work, step, 6, 1, 1e-9);
        bound(step, sums, use, cameras, t->radius_mm);
        rotation_by(step, by);
        multiply(by, R, turned, 3, 3, 3);
        memcpy(R, turned, sizeof R);
        for (int i = 0; i < 3; i++) X[i] += step[3 + i];
    }
    for (int64_t c = 0; c < cameras; c++)
        for (int i = 0; i < 3; i++)
            sums[c].to_centre[i] = X[i] - (double)t->origin[((pose * cameras + c) * 3 + i) * t->origins];
    memcpy(t->position + pose * 3, X, sizeof X), memcpy(t->rotation + pose * 9, R, sizeof R);
    memcpy(t->step + pose * 6, step, sizeof step);
    if (!t->passing) conclude(t, sums, pose, whole, step);
}

/* What the fits of one stencil need: memory for one pose at a time. */
typedef struct {
    Disk at;
    Sums *sums;
    float *floats;
    uint8_t *bytes;
    double *doubles;
} Work;

static void close_work(Work *work) { free(work->floats), free(work->bytes), free(work->sums), free(work->doubles); }

/* Return 0, or 1 without memory; to be closed in both cases. */
static int open_work(const Task *t, Work *work) {
    const int64_t P = (t->places + BLOCK - 1) / BLOCK * BLOCK, n = 6 + t->n_difference + t->n_black;
    const int64_t grids = t->most_hidden > 0 ? 4 : 0, columns = n > TINTS ? n : TINTS;
    const int64_t pairs = LANES * (columns * (columns + 3) / 2);
    memset(work, 0, sizeof *work);
    Disk *at = &work->at;
    if (grids) square_about(t, at);
    const int64_t cells = at->width * at->height;
    work->floats = malloc(sizeof(float) * (size_t)(P * (FLOATS + 2 * t->cameras) + grids * cells));
    work->bytes = malloc((size_t)(2 * P));
    work->sums = malloc(sizeof(Sums) * (size_t)t->cameras);
    work->doubles = malloc(sizeof(double) * (size_t)(pairs + t->cameras * t->tiles * n));
    if (!work->floats || !work->bytes || !work->sums || !work->doubles) return 1;
    float *next = work->floats;
    float **parts[] = {&at->paint,    &at->cover,    &at->x,       &at->y,       &at->aside,      &at->out[0],  &at->out[1],
                       &at->out[2],   &at->turn[0],  &at->turn[1], &at->turn[2], &at->move[0],    &at->move[1], &at->move[2],
                       &at->limb[0],  &at->limb[1],  &at->limb[2], &at->count,   &at->difference, &at->black,   &at->beside,
                       &at->residual, &at->variance, &at->lit};
    for (int c = 0; c < FLOATS; c++, next += P) *parts[c] = next;
    at->sorted = at->count; /* not needed at the same time */
    at->known = work->bytes, at->counts = work->bytes + P;
    at->sums = (double(*)[LANES])work->doubles;
    for (int64_t c = 0; c < t->cameras; c++, next += 2 * P) {
        Sums *of = work->sums + c;
        of->expected = next, of->weight = next + P, of->scores = work->doubles + pairs + c * t->tiles * n;
    }
    for (int64_t g = 0; g < grids; g++, next += cells) at->grid[g] = next;
    return 0;
}

/* Fit the poses from `begin` to before `end`, each by itself; return 0, or 1 without memory. */
int refine(const Task *t, int64_t begin, int64_t end) {
    Work work;
    const int without = open_work(t, &work);
    for (int64_t pose = begin; pose < end && !without; pose++) fit(t, &work.at, work.sums, pose);
    close_work(&work);
    return without;
}

/* Tell of each place what the linear problem of poses where they stand consists of, as `residuals`; returns as above. */
int linearise(const Task *t, int64_t begin, int64_t end) {
    const int64_t P = t->places, padded = (P + BLOCK - 1) / BLOCK * BLOCK, own = t->n_difference + t->n_black;
    Work work;
    const int without = open_work(t, &work);
    for (int64_t k = begin * t->cameras; k < end * t->cameras && !without; k++) {
        const int64_t pose = k / t->cameras;
        Sums *of = work.sums;
        of->position = t->start + pose * 3, of->rotation = t->start_rotation + pose * 9;
        of->kept = t->kept + k * P, of->first = !t->expected, of->last = 0;
        memcpy(of->kept, t->inside + k * P, (size_t)P);
        if (t->expected) {
            memcpy(of->expected, t->expected + k * P, sizeof(float) * (size_t)P);
            memcpy(of->weight, t->weight + k * P, sizeof(float) * (size_t)P);
        }
        sum_disk(t, &work.at, of, k);
        float *columns = t->columns + k * (FLOATS + 2) * P;
        for (int64_t c = 0; c < FLOATS; c++) memcpy(columns + c * P, work.floats + c * padded, sizeof(float) * (size_t)P);
        memcpy(columns + FLOATS * P, of->expected, sizeof(float) * (size_t)P);
        memcpy(columns + (FLOATS + 1) * P, of->weight, sizeof(float) * (size_t)P);
        memcpy(of->kept, work.at.counts, (size_t)P);
        memcpy(t->coefficients + k * own, of->coefficients, sizeof(double) * (size_t)own);
        t->deviation[k] = of->deviation;
    }
    close_work(&work);
    return without;
}

/* The fit of poses that are nearly right, as `settle` of settle.py, from whole frames. */

/* The scene of one camera, and its lines of sight. */
typedef struct {
    int64_t width, height, origins; /* origins: 1, or one for each pixel */
    const float *behind;            /* (height, width) */
    const uint8_t *shown;           /* the same, or none where nothing hides the sphere */
    const float *direction;         /* (3, height, width) */
    const float *origin;            /* (3, origins) */
    const float *axes;              /* (2, 3) */
    const float *pitch_rad;         /* (height - 1, width - 1) */
    const float *pitch_mm;          /* the same, or a single one where there is one origin */
    double full_scale;
} Scene;

/* One frame of one camera: where its rows begin, bytes to the next row and pixel, bytes of a pixel (4: single
   precision), and the pixel at the middle of the sphere. */
typedef struct {
    const char *grey;
    int64_t row, column, bytes, u, v;
} Shot;

typedef struct {
    int64_t places, inner, tiles;
    const int64_t *place, *tile;
} Stencil;

typedef struct {
    Task task;         /* all but what is cut out of frames, and the stencil */
    Stencil some, all; /* of the first stage, and of the second */
    const Scene *scene; /* (cameras) */
    const Shot *shot;   /* (poses, cameras) */
    const float *axes;   /* (poses, cameras, 2, 3), of the disks */
    const double *moved; /* (poses, 6), or none */
    int64_t some_more, all_more; /* further iterations after a long step */
    double near_rad;             /* a longer step is long */
    float most_hidden;           /* of the second stage */
    int64_t held;                /* whether each fit begins at the given position, with its precision */
    uint8_t *far; /* (poses), 1 where the first stage is left out; then where it moved the pose: nothing else is done */
    const uint8_t *some_hidden, *all_hidden; /* (poses, cameras, places), 1 where other spheres show; or none */
    /* of `settle_alone` */
    double radius_mm, hopeless; /* of a fit whose scores are less nothing more is expected */
    int64_t again;              /* times that a fit whose last step is long goes on */
} Near;

/* One pose: its disks, cut out with one stencil, and its fits. */
typedef struct {
    Task task;
    Work work;
    double X[3], R[9];
    float *pixels;  /* (cameras, 5 + 3 where each pixel has an origin, places) */
    float *single;  /* (cameras, 11): origin, axes, pitches */
    uint8_t *marks; /* (cameras, 3, places) */
    double *moved;  /* (cameras, 6) */
    const uint8_t *hidden; /* (poses, cameras, places), or none */
} Cut;

static void close_cut(Cut *cut) {
    close_work(&cut->work);
    free(cut->pixels), free(cut->single), free(cut->marks), free(cut->moved);
}

/* Return 0, or 1 without memory; to be closed in both cases. */
static int open_cut(const Near *n, const Stencil *stencil, const uint8_t *hidden, float most_hidden, Cut *cut) {
    Task *t = &cut->task;
    cut->hidden = hidden;
    *t = n->task;
    t->passing = stencil == &n->some;
    const int64_t cameras = t->cameras;
    t->places = stencil->places, t->inner = stencil->inner, t->tiles = stencil->tiles;
    t->place = stencil->place, t->tile = stencil->tile, t->most_hidden = most_hidden;
    t->origins = 1;
    for (int64_t c = 0; c < cameras; c++)
        if (n->scene[c].origins > 1) t->origins = t->places;
    const int64_t each = 5 + (t->origins > 1 ? 3 : 0);
    cut->pixels = malloc(sizeof(float) * (size_t)(cameras * each * t->places));
    cut->single = malloc(sizeof(float) * (size_t)(cameras * 11));
    cut->marks = malloc((size_t)(cameras * 3 * t->places));
    cut->moved = malloc(sizeof(double) * (size_t)(cameras * 6));
    if (open_work(t, &cut->work) || !cut->pixels || !cut->single || !cut->marks || !cut->moved) return 1;
    const int64_t all = cameras * t->places;
    t->grey = cut->pixels, t->behind = cut->pixels + all, t->direction = cut->pixels + 2 * all;
    t->origin = t->origins > 1 ? cut->pixels + 5 * all : cut->single;
    t->axes = cut->single + 3 * cameras, t->pitch_rad = cut->single + 9 * cameras, t->pitch_mm = cut->single + 10 * cameras;
    t->inside = cut->marks, t->clipped = cut->marks + all, t->kept = cut->marks + 2 * all;
    t->moved = n->moved ? cut->moved : 0;
    t->start = cut->X, t->start_rotation = cut->R;
    return 0;
}

static inline int64_t within(int64_t at, int64_t count) { return at < 0 ? 0 : at < count ? at : count - 1; }

static inline float grey_level(const Shot *shot, int64_t right, int64_t down) {
    const char *at = shot->grey + down * shot->row + right * shot->column;
    uint16_t two;
    float four;
    if (shot->bytes == 1) return (float)*(const uint8_t *)at;
    if (shot->bytes == 2) return memcpy(&two, at, sizeof two), (float)two;
    return memcpy(&four, at, sizeof four), four;
}

/* Cut the disks of a pose out of its frames, as `cut_pixels` without a blur. */
static void cut_disks(const Near *n, const Cut *cut, int64_t pose) {
    const uint8_t *hidden = cut->hidden ? cut->hidden + pose * cut->task.cameras * cut->task.places : 0;
    const Task *t = &cut->task;
    const int64_t P = t->places, all = t->cameras * P;
    uint8_t *inside = cut->marks, *clipped = cut->marks + all;
    for (int64_t c = 0; c < t->cameras; c++) {
        const Scene *scene = n->scene + c;
        const Shot *shot = n->shot + pose * t->cameras + c;
        const int64_t width = scene->width, height = scene->height, size = width * height;
        const float limit = (float)scene->full_scale;
        float *grey = cut->pixels + c * P, *behind = grey + all, *direction = cut->pixels + 2 * all + c * 3 * P;
        float *origin = cut->pixels + 5 * all + c * 3 * P;
        for (int64_t p = 0; p < P; p++) {
            const int64_t x = shot->u + t->place[p], y = shot->v + t->place[P + p];
            const int64_t right = within(x, width), down = within(y, height), at = down * width + right;
            grey[p] = grey_level(shot, right, down);
            behind[p] = scene->behind[at];
            inside[c * P + p] = x == right && y == down && (!scene->shown || scene->shown[at]) && !(hidden && hidden[c * P + p]);
            clipped[c * P + p] = grey[p] >= limit;
            for (int i = 0; i < 3; i++) direction[i * P + p] = scene->direction[i * size + at];
            if (t->origins > 1)
                for (int i = 0; i < 3; i++) origin[i * P + p] = scene->origin[i * scene->origins + (scene->origins > 1 ? at : 0)];
        }
        float *single = cut->single;
        for (int i = 0; i < 3 && t->origins == 1; i++) single[c * 3 + i] = scene->origin[i];
        for (int i = 0; i < 6; i++) single[3 * t->cameras + c * 6 + i] = n->axes[(pose * t->cameras + c) * 6 + i];
        const int64_t here = within(shot->v, height - 1) * (width - 1) + within(shot->u, width - 1);
        single[9 * t->cameras + c] = scene->pitch_rad[here];
        single[10 * t->cameras + c] = scene->pitch_mm[scene->origins > 1 ? here : 0];
        for (int i = 0; i < 6 && n->moved; i++) cut->moved[c * 6 + i] = n->moved[pose * 6 + i];
    }
}

/* Let the fits of a cut write the results of a pose. */
static void point_at(const Near *n, Task *t, int64_t pose) {
    const Task *of = &n->task;
    const int64_t cameras = t->cameras, k = pose * cameras;
    int64_t seen = 0;
    for (int64_t c = 0; c < cameras; c++) seen += of->use[k + c];
    t->use = of->use + k;
    /* All cameras together determine the position; for one of two the distance is better known from before. */
    t->place_precision = of->place_precision && (n->held || seen < cameras) ? of->place_precision + pose * 9 : 0;
    t->position = of->position + pose * 3, t->rotation = of->rotation + pose * 9;
    t->covariance = of->covariance + pose * 36, t->step = of->step + pose * 6, t->nll = of->nll + pose;
    t->own_turn = of->own_turn + k * 3, t->own_covariance = of->own_covariance + k * 9;
    t->own_move = of->own_move + k * 3, t->own_sigma = of->own_sigma + k;
    t->limb_coverage = of->limb_coverage + k, t->excess = of->excess + k, t->score = of->score + k;
}

/* Take one step, and `more` from where that one was long; return whether it was. */
static int settle_on(const Near *n, Cut *cut, int64_t pose, int64_t more) {
    Task *t = &cut->task;
    cut_disks(n, cut, pose);
    point_at(n, t, pose);
    t->iterations = 1;
    fit(t, &cut->work.at, cut->work.sums, 0);
    int64_t seen = 0;
    for (int64_t c = 0; c < t->cameras; c++) seen += t->use[c];
    /* One camera's distances scatter; a change of its picture shows in the rotation as well. */
    const double move = length(t->step + 3), limit = n->near_rad * (double)t->radius_mm;
    const int far = length(t->step) > n->near_rad || (seen > 1 && move > limit);
    if (far) {
        if (!n->held) memcpy(cut->X, t->position, sizeof cut->X);
        memcpy(cut->R, t->rotation, sizeof cut->R);
        t->iterations = more;
        fit(t, &cut->work.at, cut->work.sums, 0);
    }
    return far;
}

/* Find the place in a picture, px, whose line of sight passes through a point, by Newton's method from pixel to pixel;
   beyond the picture its border goes on. NaN where the point lies behind the camera. */
static void place_of(const Scene *scene, const double *X, double *to) {
    const int64_t width = scene->width, height = scene->height, size = width * height, each = scene->origins > 1;
    int64_t x = width / 2, y = height / 2;
    for (int round = 0; round < MOST_ROUNDS; round++) {
        const int64_t from = y * width + x, next[2] = {x + 1 < width ? 1 : -1, y + 1 < height ? width : -width};
        double to_point[3], over[2][3], along = 0, own = 0, mixed = 0, other = 0, pull[2] = {0};
        for (int i = 0; i < 3; i++) to_point[i] = X[i] - (double)scene->origin[i * scene->origins + each * from];
        const double distance = length(to_point);
        for (int i = 0; i < 3; i++) {
            const float *direction = scene->direction + i * size + from;
            const float *origin = scene->origin + i * scene->origins + each * from;
            along += to_point[i] * (double)*direction;
            for (int k = 0; k < 2; k++) {
                const double move = (double)origin[each * next[k]] - (double)*origin;
                over[k][i] = (next[k] > 0 ? 1 : -1) * ((double)direction[next[k]] - (double)*direction + move / distance);
                pull[k] += over[k][i] * (to_point[i] / distance - (double)*direction);
            }
            own += over[0][i] * over[0][i], mixed += over[0][i] * over[1][i], other += over[1][i] * over[1][i];
        }
        const double share = 1 / (own * other - mixed * mixed);
        to[0] = (double)x + share * (other * pull[0] - mixed * pull[1]);
        to[1] = (double)y + share * (own * pull[1] - mixed * pull[0]);
        const int64_t right = (int64_t)rint(fmin(fmax(to[0], 0), (double)(width - 1)));
        const int64_t down = (int64_t)rint(fmin(fmax(to[1], 0), (double)(height - 1)));
        if (right == x && down == y) {
            if (!(along > 0)) to[0] = to[1] = NAN;
            return;
        }
        x = right, y = down;
    }
}

/* Write where the disks of poses lie in a picture, (poses, 3), px: middle, and radius along the camera's x. */
void disks(const Scene *scene, const double *position, double radius_mm, double *to, int64_t poses) {
    for (int64_t pose = 0; pose < poses; pose++, position += 3, to += 3) {
        double beside[3], rim[2];
        for (int i = 0; i < 3; i++) beside[i] = position[i] + radius_mm * (double)scene->axes[i];
        place_of(scene, position, to);
        place_of(scene, beside, rim);
        to[2] = hypot(rim[0] - to[0], rim[1] - to[1]);
    }
}

/* The size of the largest record that this code reads: a caller with another one must not call it. */
int64_t refine_record(void) { return (int64_t)sizeof(Near); }

/* Fit the poses from `begin` to before `end`, each by itself; return 0, or 1 without memory. */
int settle(const Near *n, int64_t begin, int64_t end) {
    Cut some, all;
    memset(&some, 0, sizeof some), memset(&all, 0, sizeof all);
    const int without = open_cut(n, &n->some, n->some_hidden, 0.0f, &some) ||
                        open_cut(n, &n->all, n->all_hidden, n->most_hidden, &all);
    for (int64_t pose = begin; pose < end && !without; pose++) {
        const double *X = n->task.start + pose * 3, *R = n->task.start_rotation + pose * 9;
        memcpy(all.X, X, sizeof all.X), memcpy(all.R, R, sizeof all.R);
        if (!n->far[pose]) {
            memcpy(some.X, X, sizeof some.X), memcpy(some.R, R, sizeof some.R);
            n->far[pose] = (uint8_t)settle_on(n, &some, pose, n->some_more);
            if (n->far[pose]) continue; /* the disks are to be cut out anew */
            if (!n->held) memcpy(all.X, n->task.position + pose * 3, sizeof all.X);
            memcpy(all.R, n->task.rotation + pose * 9, sizeof all.R);
        }
        n->far[pose] = 0;
        settle_on(n, &all, pose, n->all_more);
    }
    close_cut(&some), close_cut(&all);
    return without;
}

/* Let the frames of one pose be cut out about where it is. */
static void look_at(const Near *n, Shot *shot) {
    for (int64_t c = 0; c < n->task.cameras; c++) {
        double at[3];
        disks(n->scene + c, n->task.start, n->radius_mm, at, 1);
        shot[c].u = isnan(at[0]) ? 0 : (int64_t)rint(at[0]), shot[c].v = isnan(at[1]) ? 0 : (int64_t)rint(at[1]);
    }
}

/* Fit one pose as `Fitter.settled`: cut out anew where it moves far, and again as long as steps are long. Its start, of
   which `position` and `rotation` are, is written over. Return 0, or 1 without memory. */
int settle_alone(const Near *n, double *position, double *rotation, Shot *shot) {
    const Task *t = &n->task;
    for (int64_t round = 0; round <= n->again; round++) {
        for (int cut = 0; cut < 2; cut++) {
            look_at(n, shot);
            *n->far = (uint8_t)cut;
            if (settle(n, 0, 1)) return 1;
            if (!*n->far) break;
            if (!n->held) memcpy(position, t->position, 3 * sizeof *position);
            memcpy(rotation, t->rotation, 9 * sizeof *rotation);
        }
        int hopeful = 0;
        for (int64_t c = 0; c < t->cameras; c++) hopeful |= t->use[c] && t->score[c] > n->hopeless;
        if (!(length(t->step) > n->near_rad) || !hopeful) break;
        if (!n->held) memcpy(position, t->position, 3 * sizeof *position);
        memcpy(rotation, t->rotation, 9 * sizeof *rotation);
    }
    return 0;
}
