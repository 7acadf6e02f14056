/* A table of the paint blurred into a wider one: what `TextureTable` of texture_table.py computes, which defines it.
   Built without fused or reordered arithmetic. */

#include "cells.h"

typedef struct {
    const float *rows; /* (side^2, 4) of the table that is blurred */
    int64_t side, cells, nodes;
    const double *centre, *right, *up; /* (cells, 3), directions and two tangents of each */
    const double *node;                /* (nodes, 3), along right and up, standard deviations, and weight */
    double width;                      /* rad, one standard deviation */
    float *to;                         /* (cells, 4) */
} Widening;

/* The size of the record that this code reads: a caller with another one must not call it. */
int64_t texture_table_record(void) { return (int64_t)sizeof(Widening); }

/* Write the wider table's tangent planes. */
void widen(const Widening *t) {
    float centre[3][BLOCK], right[3][BLOCK], up[3][BLOCK], at[3][BLOCK], plane[4][BLOCK], value[BLOCK], slope[3][BLOCK];
    int32_t cell[BLOCK];
    const float side = (float)t->side;
    for (int64_t from = 0; from < t->cells; from += BLOCK) {
        const int n = (int)(t->cells - from < BLOCK ? t->cells - from : BLOCK);
        for (int c = 0; c < 3; c++)
            for (int i = 0; i < n; i++) {
                const int64_t k = 3 * (from + i) + c;
                centre[c][i] = (float)t->centre[k];
                right[c][i] = (float)(t->width * t->right[k]);
                up[c][i] = (float)(t->width * t->up[k]);
                slope[c][i] = value[i] = 0.0f;
            }
        for (int64_t node = 0; node < t->nodes; node++) {
            const double *of = t->node + 3 * node, reach = t->width * sqrt(of[0] * of[0] + of[1] * of[1]);
            const float along = (float)of[0], across = (float)of[1], share = (float)of[2];
            const float longer = (float)sqrt(1.0 + reach * reach);
            INDEPENDENT
            for (int i = 0; i < n; i++) {
                for (int c = 0; c < 3; c++) at[c][i] = (centre[c][i] + (along * right[c][i] + across * up[c][i])) / longer;
                cell[i] = octahedral_cell(at[0][i], at[1][i], at[2][i], side);
            }
            look_up(t->rows, cell, n, plane);
            INDEPENDENT
            for (int i = 0; i < n; i++) {
                value[i] += share * (plane[0][i] + plane[1][i] * at[0][i] + plane[2][i] * at[1][i] + plane[3][i] * at[2][i]);
                for (int c = 0; c < 3; c++) slope[c][i] += share * plane[1 + c][i];
            }
        }
        for (int i = 0; i < n; i++) {
            float *to = t->to + 4 * (from + i), over = 0, left = 0;
            for (int c = 0; c < 3; c++) over += slope[c][i] * centre[c][i];
            for (int c = 0; c < 3; c++) to[1 + c] = slope[c][i] - over * centre[c][i];
            for (int c = 0; c < 3; c++) left += to[1 + c] * centre[c][i];
            to[0] = value[i] - left;
        }
    }
}
