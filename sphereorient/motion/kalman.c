/* The recursions of kalman.py, which defines them, in compiled code: run_filter and smooth.

   A transition F takes a state to `carried` times it in the first MEASURED rows and to `grown` times the rest in the
   others; most of `grown` is zero. Built without fused or reordered arithmetic. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define MEASURED 3
#define MOST 64 /* numbers of a state */

typedef struct {
    int64_t count, size, every, wanted_rows;
    const double *carried; /* (count - 1, MEASURED, size) */
    const double *drift;   /* (count - 1, MEASURED) */
    const int64_t *kind;   /* (count - 1) */
    const double *grown;   /* (kinds, size - MEASURED, size - MEASURED) */
    const double *noise;   /* (kinds, size, size) */
    const double *start;   /* (size, size) */
    const double *measured, *covariance; /* (count, MEASURED), (count, MEASURED, MEASURED) */
    const uint8_t *used;                 /* (count) */
    /* what the filter found; sums: misfit, logarithm of the determinants */
    double *state, *stored, *gain, *innovation, *inverse, *sums;
    /* what the smoother finds */
    const double *wanted; /* (wanted_rows, size) */
    double *smoothed, *spread, *mahalanobis;
} Chain;

/* A transition, and where its `grown` is not zero, by row and by column. */
typedef struct {
    const double *carried, *grown;
    int64_t size, kind;
    int by_row[MOST], by_column[MOST];
    int8_t row[MOST][MOST], column[MOST][MOST];
} Step;

static void transition(const Chain *t, int64_t k, Step *step) {
    const int rest = (int)t->size - MEASURED;
    step->carried = t->carried + k * MEASURED * t->size;
    if (step->kind == t->kind[k]) return;
    step->kind = t->kind[k];
    step->grown = t->grown + step->kind * rest * rest;
    memset(step->by_row, 0, sizeof step->by_row), memset(step->by_column, 0, sizeof step->by_column);
    for (int r = 0; r < rest; r++)
        for (int c = 0; c < rest; c++)
            if (step->grown[r * rest + c] != 0.0) {
                step->row[r][step->by_row[r]++] = (int8_t)c;
                step->column[c][step->by_column[c]++] = (int8_t)r;
            }
}

static inline void add_row(double *restrict to, const double *restrict from, double share, int64_t n) {
    for (int64_t j = 0; j < n; j++) to[j] += share * from[j];
}

/* Y = F X, for X and Y with `n` columns. */
static void forward(const Step *step, const double *X, double *Y, int64_t n) {
    const int size = (int)step->size, rest = size - MEASURED;
    memset(Y, 0, sizeof(double) * (size_t)(size * n));
    for (int r = 0; r < MEASURED; r++)
        for (int c = 0; c < size; c++) add_row(Y + r * n, X + c * n, step->carried[r * size + c], n);
    for (int r = 0; r < rest; r++)
        for (int e = 0; e < step->by_row[r]; e++) {
            const int c = step->row[r][e];
            add_row(Y + (MEASURED + r) * n, X + (MEASURED + c) * n, step->grown[r * rest + c], n);
        }
}

/* Y = F' X. */
static void backward(const Step *step, const double *X, double *Y, int64_t n) {
    const int size = (int)step->size, rest = size - MEASURED;
    memset(Y, 0, sizeof(double) * (size_t)(size * n));
    for (int c = 0; c < size; c++)
        for (int r = 0; r < MEASURED; r++) add_row(Y + c * n, X + r * n, step->carried[r * size + c], n);
    for (int c = 0; c < rest; c++)
        for (int e = 0; e < step->by_column[c]; e++) {
            const int r = step->column[c][e];
            add_row(Y + (MEASURED + c) * n, X + (MEASURED + r) * n, step->grown[r * rest + c], n);
        }
}

static void transpose(const double *X, double *Y, int64_t n) {
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < n; j++) Y[j * n + i] = X[i * n + j];
}

/* Asymmetry from rounding would grow. */
static void make_symmetric(double *P, int64_t n) {
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < i; j++) P[i * n + j] = P[j * n + i] = 0.5 * (P[i * n + j] + P[j * n + i]);
}

/* Take a symmetric P through F on both sides; the result is symmetric to the last bit. */
static void both_sides(void (*one)(const Step *, const double *, double *, int64_t), const Step *step, double *P) {
    double half[MOST * MOST], other[MOST * MOST];
    const int64_t n = step->size;
    one(step, P, half, n);
    transpose(half, other, n);
    one(step, other, P, n);
    make_symmetric(P, n);
}

/* Invert a positive definite (MEASURED, MEASURED); return the logarithm of its determinant. */
static double inverted(const double *matrix, double *inverse) {
    double left[MEASURED][MEASURED], determinant = 1.0;
    memcpy(left, matrix, sizeof left);
    for (int i = 0; i < MEASURED; i++)
        for (int j = 0; j < MEASURED; j++) inverse[i * MEASURED + j] = i == j;
    for (int k = 0; k < MEASURED; k++) {
        const double pivot = left[k][k];
        determinant *= pivot;
        for (int j = 0; j < MEASURED; j++) left[k][j] /= pivot, inverse[k * MEASURED + j] /= pivot;
        for (int i = 0; i < MEASURED; i++) {
            const double factor = left[i][k];
            if (i == k) continue;
            for (int j = 0; j < MEASURED; j++) {
                left[i][j] -= factor * left[k][j];
                inverse[i * MEASURED + j] -= factor * inverse[k * MEASURED + j];
            }
        }
    }
    return log(fabs(determinant));
}

/* P before the measurement of state k becomes P after it. */
static void updated(double *P, const double *gain, int64_t n) {
    double seen[MEASURED][MOST];
    memcpy(seen[0], P, sizeof(double) * (size_t)n);
    memcpy(seen[1], P + n, sizeof(double) * (size_t)n);
    memcpy(seen[2], P + 2 * n, sizeof(double) * (size_t)n);
    for (int64_t i = 0; i < n; i++)
        for (int m = 0; m < MEASURED; m++) add_row(P + i * n, seen[m], -gain[i * MEASURED + m], n);
    make_symmetric(P, n);
}

/* P of state k - 1 becomes that of state k before its measurement. */
static void carried_on(const Chain *t, int64_t k, Step *step, double *P) {
    transition(t, k - 1, step);
    both_sides(forward, step, P);
    add_row(P, t->noise + t->kind[k - 1] * t->size * t->size, 1.0, t->size * t->size);
}

/* The size of the record that this code reads. */
int64_t kalman_record(void) { return (int64_t)sizeof(Chain); }

/* Run the filter; return 0, or 1 for a state that is too large. */
int kalman_filter(const Chain *t) {
    const int64_t n = t->size, whole = n * n;
    Step step = {.size = n, .kind = -1};
    double P[MOST * MOST], x[MOST] = {0}, next[MOST];
    if (n > MOST) return 1;
    memcpy(P, t->start, sizeof(double) * (size_t)whole);
    t->sums[0] = t->sums[1] = 0.0;
    for (int64_t k = 0; k < t->count; k++) {
        double *gain = t->gain + k * n * MEASURED, *inverse = t->inverse + k * MEASURED * MEASURED;
        double *innovation = t->innovation + k * MEASURED;
        if (k) {
            carried_on(t, k, &step, P);
            forward(&step, x, next, 1);
            memcpy(x, next, sizeof(double) * (size_t)n);
            for (int m = 0; m < MEASURED; m++) x[m] += t->drift[(k - 1) * MEASURED + m];
        }
        if (t->used[k]) {
            double sum[MEASURED * MEASURED];
            for (int a = 0; a < MEASURED; a++)
                for (int b = 0; b < MEASURED; b++)
                    sum[a * MEASURED + b] = P[a * n + b] + t->covariance[(k * MEASURED + a) * MEASURED + b];
            t->sums[1] += inverted(sum, inverse);
            for (int m = 0; m < MEASURED; m++) innovation[m] = t->measured[k * MEASURED + m] - x[m];
            for (int64_t i = 0; i < n; i++)
                for (int m = 0; m < MEASURED; m++) {
                    double share = 0;
                    for (int a = 0; a < MEASURED; a++) share += P[i * n + a] * inverse[a * MEASURED + m];
                    gain[i * MEASURED + m] = share;
                }
            for (int64_t i = 0; i < n; i++)
                for (int m = 0; m < MEASURED; m++) x[i] += gain[i * MEASURED + m] * innovation[m];
            for (int a = 0; a < MEASURED; a++)
                for (int b = 0; b < MEASURED; b++)
                    t->sums[0] += innovation[a] * inverse[a * MEASURED + b] * innovation[b];
            updated(P, gain, n);
        }
        memcpy(t->state + k * n, x, sizeof(double) * (size_t)n);
        if (k % t->every == 0) memcpy(t->stored + k / t->every * whole, P, sizeof(double) * (size_t)whole);
    }
    return 0;
}

/* Recompute the covariances of the states from a stored one to the next. */
static void covariances(const Chain *t, int64_t first, Step *step, double *found) {
    const int64_t whole = t->size * t->size;
    memcpy(found, t->stored + first / t->every * whole, sizeof(double) * (size_t)whole);
    for (int64_t k = first + 1; k < t->count && k < first + t->every; k++) {
        double *P = found + (k - first) * whole;
        memcpy(P, P - whole, sizeof(double) * (size_t)whole);
        carried_on(t, k, step, P);
        if (t->used[k]) updated(P, t->gain + k * t->size * MEASURED, t->size);
    }
}

/* Run backwards over what the filter found; return 0, or 1 without memory. */
int kalman_smooth(const Chain *t) {
    const int64_t n = t->size, whole = n * n, rows = t->wanted_rows;
    Step step = {.size = n, .kind = -1};
    double hold[MOST * MOST] = {0}, pull[MOST] = {0}, next[MOST];
    double *block = malloc(sizeof(double) * (size_t)(t->every * whole));
    double *half = malloc(sizeof(double) * (size_t)(4 * rows * n)), *held_half = half + rows * n;
    double *across = held_half + rows * n, *turned = across + rows * n; /* half and wanted, transposed */
    if (n > MOST || !block || !half) {
        free(block), free(half);
        return 1;
    }
    for (int64_t r = 0; r < rows; r++)
        for (int64_t c = 0; c < n; c++) turned[c * rows + r] = t->wanted[r * n + c];
    for (int64_t k = t->count - 1; k >= 0; k--) {
        if (k == t->count - 1 || k % t->every == t->every - 1) covariances(t, k - k % t->every, &step, block);
        const double *P = block + k % t->every * whole;
        double *state = t->smoothed + k * n, *spread = t->spread + k * rows * rows;
        memcpy(state, t->state + k * n, sizeof(double) * (size_t)n);
        for (int64_t j = 0; j < n; j++) add_row(state, P + j * n, -pull[j], n); /* P is symmetric */
        memset(half, 0, sizeof(double) * (size_t)(2 * rows * n));
        for (int64_t r = 0; r < rows; r++)
            for (int64_t c = 0; c < n; c++)
                if (t->wanted[r * n + c] != 0.0) add_row(half + r * n, P + c * n, t->wanted[r * n + c], n);
        for (int64_t r = 0; r < rows; r++)
            for (int64_t c = 0; c < n; c++) add_row(held_half + r * n, hold + c * n, half[r * n + c], n);
        for (int64_t r = 0; r < rows; r++)
            for (int64_t c = 0; c < n; c++) across[c * rows + r] = half[r * n + c];
        memset(spread, 0, sizeof(double) * (size_t)(rows * rows));
        for (int64_t r = 0; r < rows; r++)
            for (int64_t c = 0; c < n; c++) {
                add_row(spread + r * rows, turned + c * rows, half[r * n + c], rows);
                add_row(spread + r * rows, across + c * rows, -held_half[r * n + c], rows);
            }
        t->mahalanobis[k] = 0.0;
        if (t->used[k]) {
            const double *K = t->gain + k * n * MEASURED, *inverse = t->inverse + k * MEASURED * MEASURED;
            const double *innovation = t->innovation + k * MEASURED;
            double held[MOST][MEASURED] = {{0}}, own[MEASURED * MEASURED], all[MEASURED], back[MEASURED * MEASURED];
            for (int64_t i = 0; i < n; i++)
                for (int64_t j = 0; j < n; j++)
                    for (int m = 0; m < MEASURED; m++) held[i][m] += hold[i * n + j] * K[j * MEASURED + m];
            for (int a = 0; a < MEASURED; a++) {
                all[a] = 0;
                for (int b = 0; b < MEASURED; b++) {
                    double sum = inverse[a * MEASURED + b];
                    for (int64_t i = 0; i < n; i++) sum += K[i * MEASURED + a] * held[i][b];
                    own[a * MEASURED + b] = sum;
                    all[a] += inverse[a * MEASURED + b] * innovation[b];
                }
                for (int64_t i = 0; i < n; i++) all[a] += K[i * MEASURED + a] * pull[i];
            }
            inverted(own, back);
            for (int a = 0; a < MEASURED; a++)
                for (int b = 0; b < MEASURED; b++) t->mahalanobis[k] += all[a] * back[a * MEASURED + b] * all[b];
            /* C' hold C + H' S^-1 H with C = 1 - K H, written out: only three rows and columns change */
            for (int a = 0; a < MEASURED; a++) {
                pull[a] -= all[a];
                for (int64_t j = 0; j < n; j++) hold[a * n + j] -= held[j][a];
            }
            for (int64_t i = 0; i < n; i++)
                for (int a = 0; a < MEASURED; a++) hold[i * n + a] -= held[i][a];
            for (int a = 0; a < MEASURED; a++)
                for (int b = 0; b < MEASURED; b++) hold[a * n + b] += own[a * MEASURED + b];
        }
        if (k) {
            transition(t, k - 1, &step);
            backward(&step, pull, next, 1);
            memcpy(pull, next, sizeof(double) * (size_t)n);
            both_sides(backward, &step, hold);
        }
    }
    free(block), free(half);
    return 0;
}
