/* A vehicle in six degrees of freedom, held wrenches, the classical Runge-Kutta method.

   State: position [m] NED, quaternion (w, x, y, z) body to world, velocity [m/s, rad/s] in body axes.
   M nu' + C(nu) nu + D_l nu + D_q |nu| nu + g = tau; all matrices dense, by rows. */

#include <math.h>

typedef struct {
    double inverse[36], mass[36], linear[36], quadratic[36];
    double heavy;     /* weight less buoyancy [N] */
    double moment[3]; /* of weight and buoyancy about the origin, force times lever arm [N m] */
} model_t;

static void product(const double *a, const double *v, double *out) {
    for (int i = 0; i < 6; i++) {
        double sum = 0;
        for (int j = 0; j < 6; j++) sum += a[6 * i + j] * v[j];
        out[i] = sum;
    }
}

static void cross(const double *a, const double *b, double *out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void rates(const model_t *m, const double *s, const double *tau, double *out) {
    const double *q = s + 3, *nu = s + 7;
    double size = 1 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    double w = q[0] * size, x = q[1] * size, y = q[2] * size, z = q[3] * size;
    double turn[3][3] = {
        {1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)},
        {2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)},
        {2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)},
    };
    for (int i = 0; i < 3; i++) out[i] = turn[i][0] * nu[0] + turn[i][1] * nu[1] + turn[i][2] * nu[2];
    out[3] = 0.5 * (-q[1] * nu[3] - q[2] * nu[4] - q[3] * nu[5]);
    out[4] = 0.5 * (q[0] * nu[3] + q[2] * nu[5] - q[3] * nu[4]);
    out[5] = 0.5 * (q[0] * nu[4] + q[3] * nu[3] - q[1] * nu[5]);
    out[6] = 0.5 * (q[0] * nu[5] + q[1] * nu[4] - q[2] * nu[3]);

    double momentum[6], along[6], squared[6], by_square[6], turned[3], pushed[3], spun[3], righting[3], force[6];
    product(m->mass, nu, momentum);
    product(m->linear, nu, along);
    for (int i = 0; i < 6; i++) squared[i] = fabs(nu[i]) * nu[i];
    product(m->quadratic, squared, by_square);
    cross(nu + 3, momentum, turned);
    cross(nu, momentum, pushed);
    cross(nu + 3, momentum + 3, spun);
    cross(m->moment, turn[2], righting);
    for (int i = 0; i < 3; i++) {
        force[i] = tau[i] - turned[i] - along[i] - by_square[i] + m->heavy * turn[2][i];
        force[3 + i] = tau[3 + i] - pushed[i] - spun[i] - along[3 + i] - by_square[3 + i] + righting[i];
    }
    product(m->inverse, force, out + 7);
}

static void step(const model_t *m, double dt, const double *tau, double *s) {
    static const double share[4] = {0, 0.5, 0.5, 1}, weight[4] = {1 / 6., 1 / 3., 1 / 3., 1 / 6.};
    double k[13] = {0}, at[13], sum[13] = {0};
    for (int stage = 0; stage < 4; stage++) {
        for (int i = 0; i < 13; i++) at[i] = s[i] + share[stage] * dt * k[i];
        rates(m, at, tau, k);
        for (int i = 0; i < 13; i++) sum[i] += weight[stage] * k[i];
    }
    for (int i = 0; i < 13; i++) s[i] += dt * sum[i];
}

/* States at the ends of all holds: wrenches [vehicles, steps, 6], starts [vehicles, 13],
   states [vehicles, steps, 13]. */
void roll_out(const model_t *m, int vehicles, int steps, double dt, const double *wrenches, const double *starts,
              double *states) {
    for (int v = 0; v < vehicles; v++) {
        double s[13];
        for (int i = 0; i < 13; i++) s[i] = starts[13 * v + i];
        for (int k = 0; k < steps; k++) {
            step(m, dt, wrenches + 6 * ((long)v * steps + k), s);
            for (int i = 0; i < 13; i++) states[13 * ((long)v * steps + k) + i] = s[i];
        }
    }
}
