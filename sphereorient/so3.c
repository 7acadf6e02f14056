/* exp and log of so3.py, which defines them, in double. Built without fused or reordered arithmetic. */

#include <float.h>
#include <math.h>
#include <stdint.h>

typedef struct {
    int64_t count;
    const double *from;
    double *to;
} Rotations;

/* The size of the record that this code reads: a caller with another one must not call it. */
int64_t so3_record(void) { return (int64_t)sizeof(Rotations); }

/* Write the rotations (count, 3, 3) of rotation vectors (count, 3). */
void so3_exp(const Rotations *t) {
    for (int64_t k = 0; k < t->count; k++) {
        const double *v = t->from + 3 * k, x = v[0], y = v[1], z = v[2];
        double *to = t->to + 9 * k;
        const double angle = sqrt(x * x + y * y + z * z);
        const int some = !(angle <= sqrt(sqrt(DBL_MIN))); /* NaN stays NaN */
        const double half = some ? sin(angle / 2) / angle : 0, along = some ? sin(angle) / angle : 1;
        const double across = some ? 2 * (half * half) : 0.5;
        const double K[9] = {0, -z, y, z, 0, -x, -y, x, 0};
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) {
                double square = 0;
                for (int l = 0; l < 3; l++) square += K[3 * i + l] * K[3 * l + j];
                to[3 * i + j] = (i == j) + along * K[3 * i + j] + across * square;
            }
    }
}

/* Write the rotation vectors (count, 3) of rotations (count, 3, 3). */
void so3_log(const Rotations *t) {
    for (int64_t k = 0; k < t->count; k++) {
        const double *R = t->from + 9 * k;
        double *to = t->to + 3 * k;
        const double x = R[7] - R[5], y = R[2] - R[6], z = R[3] - R[1];
        const double xy = R[1] + R[3], xz = R[2] + R[6], yz = R[5] + R[7];
        /* Four times the products of the quaternion's components (w, x, y, z), row by row. */
        const double products[4][4] = {
            {1 + R[0] + R[4] + R[8], x, y, z},
            {x, 1 + R[0] - R[4] - R[8], xy, xz},
            {y, xy, 1 - R[0] + R[4] - R[8], yz},
            {z, xz, yz, 1 - R[0] - R[4] + R[8]},
        };
        int largest = 0;
        for (int row = 1; row < 4; row++)
            if (products[row][row] > products[largest][largest]) largest = row;
        const double *quat = products[largest], sign = quat[0] < 0 ? -1 : 1;
        const double length = sqrt(quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
        const int turned = !(length <= sqrt(DBL_MIN)); /* NaN stays NaN */
        const double by = turned ? 2 * atan2(length, fabs(quat[0])) / length : 0.5;
        for (int i = 0; i < 3; i++) to[i] = sign * quat[1 + i] * by;
    }
}
