/* Look-ups in tables over cells of directions, see texture_table.py, block by block: the data stay in the first cache. */

#include <math.h>
#include <stdint.h>

#define BLOCK 256

/* The iterations of the next loop do not depend on each other: no array is reached by two names. */
#if defined(__clang__)
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#elif defined(__GNUC__)
#define INDEPENDENT _Pragma("GCC ivdep")
#else
#define INDEPENDENT
#endif

static inline float least(float a, float b) { return a < b ? a : b; }
static inline float most(float a, float b) { return a > b ? a : b; }

/* The place of a number within 0 .. count - 1; NaN goes to 0. */
static inline int32_t placed(float at, float count) {
    at = at > 0.0f ? at : 0.0f;
    return (int32_t)(at < count - 1.0f ? at : count - 1.0f);
}

static inline int32_t octahedral_cell(float x, float y, float z, float side) {
    const float half = 0.5f * side, scale = half / (fabsf(x) + fabsf(y) + fabsf(z));
    float u = x * scale, v = y * scale;
    const float folded_u = copysignf(half - fabsf(v), u), folded_v = copysignf(half - fabsf(u), v);
    u = z < 0 ? folded_u : u;
    v = z < 0 ? folded_v : v;
    return placed(v + half, side) * (int32_t)side + placed(u + half, side);
}

/* Write the rows of some cells of a table. */
static void look_up(const float *rows, const int32_t *cell, int n, float to[4][BLOCK]) {
    for (int i = 0; i < n; i++) {
        const float *row = rows + 4 * (int64_t)cell[i];
        for (int c = 0; c < 4; c++) to[c][i] = row[c];
    }
}
