/* The paint of a ball in cells of directions, as pictures show it: what `PaintCells` of paint_cells.py computes, which
   defines it. Built without fused or reordered arithmetic. */

#include "../sphere/cells.h"

#define TERMS 10 /* of a polynomial of third order in two variables */

typedef struct {
    int64_t cells, width, height, left, top; /* of the picture, px; its first pixel in the camera's picture */
    const float *direction;                  /* (cells, 3), unit, of the body */
    const int32_t *beside;                   /* (cells, 4), cells beside each */
    const float *slope_by;                   /* (cells, 4, 3), slope by what these differ from it */
    const float *grey;                       /* (height, width) */
    const uint8_t *counts;                   /* the same */
    const double *turn;                      /* (3, 3), from the body to the view: right, down, to the camera */
    const double *place;                     /* (2, TERMS), px, of the slopes of a line of sight times the distance */
    double distance, least_cosine;           /* of the camera, radii; of the slant at which a picture shows paint */
    float least_weight;                      /* below it a cell is unseen */
    float *weight, *total;                   /* (cells), summed */
    float *rows, *unseen;                    /* (cells, 4), tangent planes of the mean, and of what is unseen */
} Growing;

/* The size of the record that this code reads: a caller with another one must not call it. */
int64_t paint_cells_record(void) { return (int64_t)sizeof(Growing); }

/* Add what a picture shows of one cell; return whether it shows it. */
static int add(const Growing *g, int64_t k) {
    double view[3];
    for (int i = 0; i < 3; i++) {
        view[i] = 0;
        for (int c = 0; c < 3; c++) view[i] += g->turn[3 * i + c] * (double)g->direction[3 * k + c];
    }
    const double D = g->distance, away = sqrt(D * D + 1 - 2 * D * view[2]), cosine = (D * view[2] - 1) / away;
    if (!(cosine > g->least_cosine)) return 0;
    const double a = view[0] * D / (D - view[2]), b = view[1] * D / (D - view[2]);
    const double terms[TERMS] = {1, a, b, a * a, a * b, b * b, a * a * a, a * a * b, a * b * b, b * b * b};
    double u = -(double)g->left, v = -(double)g->top;
    for (int t = 0; t < TERMS; t++) u += g->place[t] * terms[t], v += g->place[TERMS + t] * terms[t];
    if (!(u >= 0 && v >= 0 && u < (double)(g->width - 1) && v < (double)(g->height - 1))) return 0;
    const int64_t x = (int64_t)u, y = (int64_t)v, at = y * g->width + x, below = at + g->width;
    if (!(g->counts[at] && g->counts[at + 1] && g->counts[below] && g->counts[below + 1])) return 0;
    const float right = (float)(u - (double)x), down = (float)(v - (double)y), *grey = g->grey;
    const float upper = grey[at] + right * (grey[at + 1] - grey[at]);
    const float lower = grey[below] + right * (grey[below + 1] - grey[below]);
    const float weight = (float)(cosine * cosine);
    g->weight[k] += weight;
    g->total[k] += weight * (upper + down * (lower - upper));
    return 1;
}

static float mean(const Growing *g, int64_t k) { return g->total[k] / g->weight[k]; }

/* Add a picture, and write the tables anew where it shows the ball; return the number of cells that it shows. */
int64_t grow(const Growing *g) {
    int64_t count = 0;
    for (int64_t k = 0; k < g->cells; k++) {
        const int shown = add(g, k);
        g->unseen[4 * k] = shown && g->weight[k] >= g->least_weight ? 2.0f : g->unseen[4 * k]; /* 2: marked */
        count += shown;
    }
    for (int64_t k = 0; k < g->cells; k++) {
        if (g->unseen[4 * k] != 2.0f) continue;
        const float here = mean(g, k);
        float *row = g->rows + 4 * k;
        row[0] = here, row[1] = row[2] = row[3] = 0.0f;
        for (int n = 0; n < 4; n++) {
            const int64_t other = g->beside[4 * k + n];
            const float differs = g->weight[other] >= g->least_weight ? mean(g, other) - here : 0.0f;
            for (int c = 0; c < 3; c++) row[1 + c] += differs * g->slope_by[12 * k + 3 * n + c];
        }
        g->unseen[4 * k] = 0.0f;
    }
    return count;
}
