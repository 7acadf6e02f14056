/* The paint of a ball in cells of directions, as pictures show it: what `PaintCells` of paint_cells.py computes, which
   defines it. Built without fused or reordered arithmetic. */

#include <string.h>

#include "../sphere/cells.h"

#define TERMS 10 /* of a polynomial of third order in two variables */

typedef struct {
    int64_t cells, width, height; /* of the picture, px */
    const float *direction;       /* (3, cells), unit, of the body */
    const int32_t *beside;        /* (cells, 4), cells beside each */
    const float *slope_by;        /* (cells, 4, 3), slope by what these differ from it */
    const float *grey;            /* (height, width) */
    const uint8_t *counts;        /* the same */
    const float *turn;            /* (3, 3), from the body to the view: right, down, to the camera */
    const float *place;           /* (2, TERMS), px, of the slopes of a line of sight times the distance */
    float distance, least_cosine; /* of the camera, radii; of the slant at which a picture shows paint */
    float least_weight;           /* below it a cell is unseen */
    float *weight, *mean;         /* (cells), of what pictures showed */
    float *rows, *unseen;         /* (cells, 4), tangent planes of the mean, and of what is unseen */
    int32_t *shown;               /* (cells), work: which ones the picture shows */
    float *here, *cosine;         /* (cells), of `see`: grey and slant of what the picture shows, 0 elsewhere */
    int32_t *nearest;             /* (cells), of `see`: the pixel */
} Growing;

/* The size of the record that this code reads: a caller with another one must not call it. */
int64_t paint_cells_record(void) { return (int64_t)sizeof(Growing); }

/* Write which cells of a block a picture may show, by how far they lie before the ball's centre. */
static int before_centre(const Growing *g, int64_t from, int n, int32_t *found) {
    const float D = g->distance, *x = g->direction + from, *y = x + g->cells, *z = y + g->cells, *towards = g->turn + 6;
    uint8_t seen[BLOCK];
    INDEPENDENT
    for (int i = 0; i < n; i++) seen[i] = D * (towards[0] * x[i] + towards[1] * y[i] + towards[2] * z[i]) > 1.0f;
    int count = 0;
    for (int i = 0; i < n; i++) found[count] = (int32_t)from + i, count += seen[i];
    return count;
}

/* What a picture shows of some cells. */
typedef struct {
    int32_t cell[BLOCK + 1], nearest[BLOCK];
    float here[BLOCK], cosine[BLOCK];
} Shown;

/* Look up `n` cells in a picture; keep those that it shows, return their number. */
static int look(const Growing *g, Shown *s, int n) {
    const int32_t *cell = s->cell;
    float view[3][BLOCK], u[BLOCK], v[BLOCK], cosine[BLOCK];
    const float D = g->distance, *p = g->place, *q = p + TERMS;
    for (int c = 0; c < 3; c++) {
        const float *turn = g->turn + 3 * c, *x = g->direction, *y = x + g->cells, *z = y + g->cells;
        for (int i = 0; i < n; i++) view[c][i] = turn[0] * x[cell[i]] + turn[1] * y[cell[i]] + turn[2] * z[cell[i]];
    }
    INDEPENDENT
    for (int i = 0; i < n; i++) {
        const float z = view[2][i], nearer = D / (D - z), a = view[0][i] * nearer, b = view[1][i] * nearer;
        const float aa = a * a, ab = a * b, bb = b * b;
        cosine[i] = (D * z - 1.0f) / sqrtf(D * D + 1.0f - 2.0f * D * z);
        u[i] = p[0] + p[1] * a + p[2] * b + p[3] * aa + p[4] * ab + p[5] * bb + p[6] * aa * a + p[7] * aa * b + p[8] * bb * a + p[9] * bb * b;
        v[i] = q[0] + q[1] * a + q[2] * b + q[3] * aa + q[4] * ab + q[5] * bb + q[6] * aa * a + q[7] * aa * b + q[8] * bb * a + q[9] * bb * b;
    }
    const float right_most = (float)(g->width - 1), down_most = (float)(g->height - 1);
    int count = 0;
    for (int i = 0; i < n; i++) {
        if (!(cosine[i] > g->least_cosine && u[i] >= 0 && v[i] >= 0 && u[i] < right_most && v[i] < down_most)) continue;
        const int64_t x = (int64_t)u[i], y = (int64_t)v[i], at = y * g->width + x, below = at + g->width;
        const uint8_t *counts = g->counts;
        if (!(counts[at] & counts[at + 1] & counts[below] & counts[below + 1])) continue;
        const float right = u[i] - (float)x, down = v[i] - (float)y, *grey = g->grey;
        const float upper = grey[at] + right * (grey[at + 1] - grey[at]);
        const float lower = grey[below] + right * (grey[below + 1] - grey[below]);
        s->cell[count] = cell[i], s->here[count] = upper + down * (lower - upper), s->cosine[count] = cosine[i];
        s->nearest[count++] = (int32_t)((int64_t)(v[i] + 0.5f) * g->width + (int64_t)(u[i] + 0.5f));
    }
    return count;
}

/* Return how many cells from one on a picture shows, and what. */
static int shown_from(const Growing *g, int64_t from, Shown *s) {
    const int n = (int)(g->cells - from < BLOCK ? g->cells - from : BLOCK);
    return look(g, s, before_centre(g, from, n, s->cell));
}

/* Write what a picture shows of all cells. */
void see(const Growing *g) {
    Shown s;
    memset(g->here, 0, (size_t)g->cells * sizeof(float));
    memset(g->cosine, 0, (size_t)g->cells * sizeof(float));
    memset(g->nearest, 0, (size_t)g->cells * sizeof(int32_t));
    for (int64_t from = 0; from < g->cells; from += BLOCK) {
        const int count = shown_from(g, from, &s);
        for (int i = 0; i < count; i++) {
            const int64_t k = s.cell[i];
            g->here[k] = s.here[i], g->cosine[k] = s.cosine[i], g->nearest[k] = s.nearest[i];
        }
    }
}

/* Add a picture, and write the tables anew where it shows the ball; return the number of cells that it shows. */
int64_t grow(const Growing *g) {
    Shown s;
    int64_t count = 0;
    for (int64_t from = 0; from < g->cells; from += BLOCK) {
        const int here = shown_from(g, from, &s);
        for (int i = 0; i < here; i++) {
            const int64_t k = s.cell[i];
            const float weight = s.cosine[i] * s.cosine[i];
            g->weight[k] += weight;
            g->mean[k] += weight / g->weight[k] * (s.here[i] - g->mean[k]);
            g->shown[count++] = (int32_t)k;
        }
    }
    for (int64_t i = 0; i < count; i++) {
        const int64_t k = g->shown[i];
        if (g->weight[k] < g->least_weight) continue;
        const float here = g->mean[k], *by = g->slope_by + 12 * k;
        float slope[3] = {0};
        for (int n = 0; n < 4; n++) {
            const int64_t other = g->beside[4 * k + n];
            const float differs = g->weight[other] >= g->least_weight ? g->mean[other] - here : 0.0f;
            for (int c = 0; c < 3; c++) slope[c] += differs * by[3 * n + c];
        }
        float *row = g->rows + 4 * k;
        row[0] = here, row[1] = slope[0], row[2] = slope[1], row[3] = slope[2];
        g->unseen[4 * k] = 0.0f;
    }
    return count;
}
