/* Rollouts of a loop and their exact derivatives, a few windows of time side by side: `loop.py` and `sensitivity.py`
   as machine code, for trees of turning and sliding joints and for one joint that is carried by a measured arm.

   A step is solved (rigid body, drives, dry friction and limits as soft constraints), then linearised where it stands,
   and the sensitivities are carried on: x' = A x + B. Spatial vectors stand in the world's axes at the world's origin,
   angular part first. Derivatives of the rigid body: S. Singh, R. P. Russell, P. M. Wensing, "Efficient analytical
   derivatives of rigid-body dynamics using spatial vector algebra", IEEE RA-L 7 (2022). */

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#if SIZE /* coordinates, where they are few and known */
#define MOST SIZE
#else
#define MOST 32
#endif
#define ACTING 32 /* drives */
#if SIZE == 1 || SIZE == 2
#define LANES 2 /* windows that are simulated side by side, their rigid bodies at once: a servo has often one alone */
#else
#define LANES 8
#endif
#define ROWS 64 /* numbers that are read at an instant: positions and rates */
#define PAIRS 64 /* couplings of two coordinates that act */
#define TURNS 60 /* Newton steps of the constraints; 1 to 4 are used */
#define INLINE static inline __attribute__((always_inline))
#define WIDE static __attribute__((noinline, optimize("O3"))) /* loops over columns, in vectors */
#if SIZE
#define ALIKE INLINE
#else
#define ALIKE APART
#endif
#define APART static __attribute__((noinline, optimize("O3"))) /* where the time goes */

enum joint_number {
  ARMATURE, DAMPING, FRICTION, PEAK, SPEED, RATIO, STIFFNESS, REST, PLAY, OFFSET, SINE, COSINE, ORDER, READING,
  RATE, SHARE, LEAST, LARGEST, LOWER, UPPER, MARGIN, TIME, DAMPED, LOWEST, HIGHEST, WIDTH, MIDDLE, POWER
};
enum drive_number { SCALE, DELAY, DEAD, VOLTAGE, GAIN0, GAIN1, GAIN2, BIAS0, BIAS1, BIAS2, FROM, TO, WEAKEST, STRONGEST };
enum pair_number { TOGETHER, DRAG, RUB }; /* inertia, damping, dry friction of a motor that turns with both */
enum unknown { OF_DRIVE = 100, LIMIT = 110, KP, KD, PAIR = 120, BODY = 200, PULL, CARRIED_BODY };

typedef struct {
  long n, nu, links, ny, rates, carried, hard, limited;
  long implicit, drag; /* the step takes the drives' slopes, and the joints' damping, at its end */
  long windows, rows, lead, substeps, block, many, columns, pairs;
  double dt;
  const long *measured;                      /* (ny) */
  const long *parent, *coordinate, *slides;  /* (n) of each tree joint */
  const double *placement, *axis, *inertia;  /* (n, 16), (n, 3), (n, 10) */
  const double *gravity, *start;             /* (3), (n) */
  const double *joint, *drive, *way;         /* (28, n), (14, nu), (nu, n) */
  const double *payload, *resting;           /* (links), (2): mass and share of a carried joint */
  const long *kind, *place, *column;         /* (many) of the unknowns */
  const double *ten;                         /* (many, 10), of unknowns of the rigid body */
  const double *pair;                        /* (3, pairs) */
  const long *joined;                        /* (pairs, 3): two coordinates, and the sign of the second */
  const double *command, *reading, *weight, *load, *begin; /* (lead + rows, nu, windows) ... (2 n, windows) */
  const double *pole;                        /* (wide, windows) of the noise, or none where it is white */
  double *cost, *gradient, *matrix, *read;   /* sums, or what is read alone where `cost` is none */
} Given;

typedef double D __attribute__((vector_size(8 * LANES))); /* a number of each of the windows side by side */

typedef struct {
  D R[9], p[3], S[6], V[6], A[6], T[6]; /* T: V of the parent x S */
  double m, mass;                       /* of the link, then of all that it carries; of the link */
  D h[3], J[6];                         /* the same: xx xy yy xz yz zz */
  D own[9];                             /* of the link: h, J */
  D F[6], P[6], B[9];                   /* force, momentum, the upper left part of 2 B */
} Body;

typedef struct { /* the rigid bodies of the windows side by side */
  Body body[MOST];
  int lanes;
  D q[MOST], v[MOST], a[MOST], moved[MOST]; /* a: of the constraints; moved: of the integrator less a */
  D M[MOST * MOST], bias[MOST];
  D by_q[MOST * MOST], by_v[MOST * MOST], second[MOST * MOST]; /* slopes of the torques at a, and of those at moved */
  D idle_q[MOST * MOST], idle_v[MOST * MOST];                  /* of the bias, where friction follows the load */
  D *unit;                                                     /* (many, 3, n) torques of a unit: at a, at moved, of the bias */
} Rigid;

typedef struct { /* a joint limit: force (pull - a) / soft where it acts, with derivatives by distance and rate */
  double pull, soft, by, by_rate, log_soft;
  int on;
} Side;

typedef struct {
  double q[MOST], v[MOST], a[MOST], moved[MOST], force[MOST]; /* a: of the constraints; moved: of the integrator */
  double M[MOST * MOST], K[MOST * MOST], L[MOST * MOST];      /* with armature; inverses of the constraints', of the step's */
  double D[MOST * MOST], bias[MOST], torque[MOST], motor[MOST];
  double level[MOST], peak[MOST], pull[MOST], soft[MOST], weight[MOST];
  Side side[2][MOST];
  int slip[MOST], within[MOST];
  double u[ACTING], faster[ACTING], by_length[ACTING], by_rate[ACTING], by_u[ACTING], slope[ACTING], length[ACTING], rate[ACTING];
  double part[ACTING], often; /* of a delay in steps */
  int whole[ACTING];
  int pairs, one[PAIRS], two[PAIRS], held[PAIRS]; /* couplings that act; held: 0, or the sign of the friction that slips */
  long which[PAIRS];
  double way[PAIRS], pair_level[PAIRS], pair_pull[PAIRS], pair_soft[PAIRS], pair_weight[PAIRS];
  double by_scale[ACTING], by_gain[ACTING], by_band[ACTING];
  int volt[ACTING], limit[ACTING], inside[ACTING], stepped[ACTING]; /* stepped: the implicit step takes its slope */
  double mass, base, steep, at;                               /* of a carried joint */
  const double *more;
} Work;

INLINE void cross(const D *a, const D *b, D *c) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}
INLINE D dot3(const D *a, const D *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
INLINE D dot6(const D *a, const D *b) { return dot3(a, b) + dot3(a + 3, b + 3); }
#define TURNED(R, x, y) for (int i = 0; i < 3; i++) (y)[i] = (R)[3 * i] * (x)[0] + (R)[3 * i + 1] * (x)[1] + (R)[3 * i + 2] * (x)[2]
/* motion x motion, motion x force */
INLINE void crossed(const D *V, const D *S, D *out) {
  D x[3], y[3];
  cross(V, S, out);
  cross(V, S + 3, x);
  cross(V + 3, S, y);
  for (int k = 0; k < 3; k++) out[3 + k] = x[k] + y[k];
}
INLINE void crossed_force(const D *V, const D *F, D *out) {
  D x[3], y[3];
  cross(V, F, x);
  cross(V + 3, F + 3, y);
  cross(V, F + 3, out + 3);
  for (int k = 0; k < 3; k++) out[k] = x[k] + y[k];
}
INLINE void inertial(double m, const D *h, const D *J, const D *V, D *F) {
  D x[3], y[3];
  cross(h, V + 3, x);
  cross(h, V, y);
  F[0] = J[0] * V[0] + J[1] * V[1] + J[3] * V[2] + x[0];
  F[1] = J[1] * V[0] + J[2] * V[1] + J[4] * V[2] + x[1];
  F[2] = J[3] * V[0] + J[4] * V[1] + J[5] * V[2] + x[2];
  for (int k = 0; k < 3; k++) F[3 + k] = m * V[3 + k] - y[k];
}

/* ten numbers of a link in its own axes at its own origin -> at the world's */
APART void placed(const double *ten, const D *R, const D *p, double *m, D *h, D *J) {
  const double I[9] = {ten[4], ten[5], ten[7], ten[5], ten[6], ten[8], ten[7], ten[8], ten[9]};
  D RI[9], W[9], s[3];
  *m = ten[0];
  TURNED(R, ten + 1, s);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) RI[3 * i + j] = R[3 * i] * I[j] + R[3 * i + 1] * I[3 + j] + R[3 * i + 2] * I[6 + j];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j <= i; j++) {
      D x = RI[3 * i] * R[3 * j] + RI[3 * i + 1] * R[3 * j + 1] + RI[3 * i + 2] * R[3 * j + 2];
      x -= p[i] * s[j] + s[i] * p[j] + *m * p[i] * p[j];
      if (i == j) x += 2 * dot3(p, s) + *m * dot3(p, p);
      W[3 * i + j] = x;
    }
  J[0] = W[0], J[1] = W[3], J[2] = W[4], J[3] = W[6], J[4] = W[7], J[5] = W[8];
  for (int k = 0; k < 3; k++) h[k] = s[k] + *m * p[k];
}

/* poses, velocities, accelerations without those of the joints, masses and bias */
APART void posed(const Given *g, Rigid *w, const int n, const D *q, const D *v) {
  const D none = {0}, zero[6] = {none}, one[9] = {none + 1, none, none, none, none + 1, none, none, none, none + 1};
  const D ground[6] = {none, none, none, none - g->gravity[0], none - g->gravity[1], none - g->gravity[2]};
  for (int i = 0; i < n; i++) {
    Body *b = w->body + i;
    const long up = g->parent[i], c = g->coordinate[i];
    const D *R0 = up < 0 ? one : w->body[up].R, *p0 = up < 0 ? zero : w->body[up].p;
    const D *V0 = up < 0 ? zero : w->body[up].V, *A0 = up < 0 ? ground : w->body[up].A;
    const double *H = g->placement + 16 * i, *e = g->axis + 3 * i;
    D C[9], x[3];
    for (int r = 0; r < 3; r++) {
      for (int k = 0; k < 3; k++) C[3 * r + k] = R0[3 * r] * H[k] + R0[3 * r + 1] * H[4 + k] + R0[3 * r + 2] * H[8 + k];
      b->p[r] = p0[r] + R0[3 * r] * H[3] + R0[3 * r + 1] * H[7] + R0[3 * r + 2] * H[11];
    }
    TURNED(C, e, x);
    if (g->slides[i]) {
      memcpy(b->R, C, sizeof C);
      for (int k = 0; k < 3; k++) b->p[k] += x[k] * q[c], b->S[k] = none, b->S[3 + k] = x[k];
    } else {
      D s = none, k = none;
      for (int l = 0; l < w->lanes; l++) s[l] = sin(q[c][l]), k[l] = cos(q[c][l]);
      const D r = 1 - k;
      const D E[9] = {k + r * e[0] * e[0], r * e[0] * e[1] - s * e[2], r * e[0] * e[2] + s * e[1],
                           r * e[1] * e[0] + s * e[2], k + r * e[1] * e[1], r * e[1] * e[2] - s * e[0],
                           r * e[2] * e[0] - s * e[1], r * e[2] * e[1] + s * e[0], k + r * e[2] * e[2]};
      for (int i2 = 0; i2 < 3; i2++)
        for (int j = 0; j < 3; j++) b->R[3 * i2 + j] = C[3 * i2] * E[j] + C[3 * i2 + 1] * E[3 + j] + C[3 * i2 + 2] * E[6 + j];
      memcpy(b->S, x, sizeof x);
      cross(b->p, x, b->S + 3);
    }
    crossed(V0, b->S, b->T);
    for (int k = 0; k < 6; k++) b->V[k] = V0[k] + b->S[k] * v[c], b->A[k] = A0[k] + b->T[k] * v[c];
    placed(g->inertia + 10 * i, b->R, b->p, &b->m, b->h, b->J);
    b->mass = b->m, memcpy(b->own, b->h, sizeof b->h), memcpy(b->own + 3, b->J, sizeof b->J);
    inertial(b->m, b->h, b->J, b->V, b->P);
    D f[6];
    inertial(b->m, b->h, b->J, b->A, b->F);
    crossed_force(b->V, b->P, f);
    for (int k = 0; k < 6; k++) b->F[k] += f[k];
  }
}

APART void momentum_slope(Body *b) { /* the upper left part of 2 B = V x* I - I V x + (I V) x* */
  const D *w = b->V, *v = b->V + 3, *h = b->h, *J = b->J, *n = b->P;
  const D o = {0}, W[9] = {o, -w[2], w[1], w[2], o, -w[0], -w[1], w[0], o};
  const D I[9] = {J[0], J[1], J[3], J[1], J[2], J[4], J[3], J[4], J[5]};
  const D N[9] = {o, -n[2], n[1], n[2], o, -n[0], -n[1], n[0], o};
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      D x = -N[3 * i + j] - (v[j] * h[i] + h[j] * v[i]);
      for (int k = 0; k < 3; k++) x += W[3 * i + k] * I[3 * k + j] - I[3 * i + k] * W[3 * k + j];
      if (i == j) x += 2 * dot3(v, h);
      b->B[3 * i + j] = x;
    }
}

APART void summed_up(const Given *g, Rigid *w, const int n, const int all) {
  for (int i = n - 1; i >= 0; i--) {
    Body *b = w->body + i;
    if (g->parent[i] < 0) continue;
    Body *u = w->body + g->parent[i];
    for (int k = 0; k < 6; k++) u->F[k] += b->F[k];
    if (all) {
      u->m += b->m;
      for (int k = 0; k < 3; k++) u->h[k] += b->h[k];
      for (int k = 0; k < 6; k++) u->J[k] += b->J[k], u->P[k] += b->P[k];
      for (int k = 0; k < 9; k++) u->B[k] += b->B[k];
    }
  }
}

/* inverse of a symmetric positive matrix, in place */
WIDE void swept(double *A, const int n) {
  for (int k = 0; k < n; k++) {
    const double d = 1 / A[k * n + k];
    double row[MOST];
    for (int j = 0; j < n; j++) row[j] = A[k * n + j] * d;
    for (int i = 0; i < n; i++) {
      if (i == k) continue;
      const double f = A[i * n + k];
      for (int j = 0; j < n; j++) A[i * n + j] -= f * row[j];
      A[i * n + k] = f * d;
    }
    for (int j = 0; j < n; j++) A[k * n + j] = row[j];
    A[k * n + k] = -d;
  }
  for (int k = 0; k < n * n; k++) A[k] = -A[k];
}
INLINE void inverted(double *A, const int n) {
  if (n == 1) {
    A[0] = 1 / A[0];
    return;
  }
  if (n > 2) {
    swept(A, n);
    return;
  }
  const double one = 1 / (A[0] * A[3] - A[1] * A[2]), a = A[0];
  A[0] = A[3] * one, A[1] *= -one, A[2] *= -one, A[3] = a * one;
}

APART void masses(const Given *g, Rigid *w, const int n, D *M) {
  memset(M, 0, sizeof(D) * n * n);
  for (int i = 0; i < n; i++) {
    Body *b = w->body + i;
    D z[6];
    inertial(b->m, b->h, b->J, b->S, z);
    for (long j = i; j >= 0; j = g->parent[j]) {
      const long a = g->coordinate[i], c = g->coordinate[j];
      M[a * n + c] = M[c * n + a] = dot6(w->body[j].S, z);
    }
  }
}

/* torques of a unit of the rigid body's unknown `k` at accelerations A of the bodies; `rigid`: without velocities */
APART void unit_torques(const Given *g, const Rigid *w, const int n, const long k, D A[][6], int rigid, D *out) {
  memset(out, 0, sizeof(D) * n);
  if (g->kind[k] == PULL) {
    if (rigid) return;
    D F[MOST][6];
    for (int i = n - 1; i >= 0; i--) {
      D a[6] = {{0}};
      for (int x = 0; x < 3; x++) a[3 + x] -= g->ten[10 * k + x]; /* by which gravity turns */
      inertial(w->body[i].m, w->body[i].h, w->body[i].J, a, F[i]); /* of all that it carries */
      out[g->coordinate[i]] = dot6(w->body[i].S, F[i]);
    }
    return;
  }
  const long i = g->place[k];
  double m;
  D h[3], J[6], F[6], P[6], f[6];
  placed(g->ten + 10 * k, w->body[i].R, w->body[i].p, &m, h, J);
  inertial(m, h, J, A[i], F);
  if (!rigid) {
    inertial(m, h, J, w->body[i].V, P);
    crossed_force(w->body[i].V, P, f);
    for (int c = 0; c < 6; c++) F[c] += f[c];
  }
  for (long j = i; j >= 0; j = g->parent[j]) out[g->coordinate[j]] = dot6(w->body[j].S, F);
}

#define JN(name) (g->joint[(name) * n + j])
#define DN(name) (g->drive[(name) * g->nu + d])
#define PN(name) (g->pair[(name) * g->pairs + w->which[k]])

/* softness of the constraints, and the logarithm's derivative by each unknown */
APART void mobility(const Given *g, Rigid *rigid, Work *w, const int n, double *by) {
  double M[MOST * MOST];
  rigid->lanes = 1; /* it is the same in all windows */
  if (g->carried) {
    for (int k = 0; k < n * n; k++) M[k] = g->resting[0];
  } else {
    for (int j = 0; j < n; j++) rigid->q[j][0] = g->start[j];
    posed(g, rigid, n, rigid->q, rigid->v);
    summed_up(g, rigid, n, 1);
    masses(g, rigid, n, rigid->M);
    for (int k = 0; k < n * n; k++) M[k] = rigid->M[k][0];
  }
  for (int j = 0; j < n; j++) M[j * n + j] += JN(ARMATURE);
  for (int k = 0; k < w->pairs; k++) {
    const int i = w->one[k], j = w->two[k];
    M[i * n + j] += w->way[k] * PN(TOGETHER), M[j * n + i] += w->way[k] * PN(TOGETHER);
  }
  inverted(M, n);
  double turn[PAIRS][MOST];
  for (int j = 0; j < n; j++) w->weight[j] = M[j * n + j] * (g->carried ? g->resting[1] : 1);
  for (int k = 0; k < w->pairs; k++) {
    for (int j = 0; j < n; j++) turn[k][j] = M[w->one[k] * n + j] + w->way[k] * M[w->two[k] * n + j];
    w->pair_weight[k] = turn[k][w->one[k]] + w->way[k] * turn[k][w->two[k]];
  }
  memset(by, 0, sizeof(double) * (n + w->pairs) * g->many);
  double *by_pair = by + n * g->many;
  for (long k = 0; k < g->many; k++) {
    double dM[MOST * MOST];
    if (g->kind[k] == ARMATURE || g->kind[k] == PAIR + TOGETHER) {
      const int same = g->kind[k] == ARMATURE, i = same ? (int)g->place[k] : (int)g->joined[3 * g->place[k]];
      const int other = same ? i : (int)g->joined[3 * g->place[k] + 1];
      const double size = same ? 1 : 2.0 * (double)g->joined[3 * g->place[k] + 2];
      for (int j = 0; j < n; j++) by[k * n + j] = -size * M[j * n + i] * M[j * n + other] / M[j * n + j];
      for (int p = 0; p < w->pairs; p++) by_pair[k * w->pairs + p] = -size * turn[p][i] * turn[p][other] / w->pair_weight[p];
    }
    if (g->kind[k] != BODY) continue;
    for (int c = 0; c < n; c++) {
      D A[MOST][6], torque[MOST];
      for (int i = 0; i < n; i++) {
        for (int r = 0; r < 6; r++) {
          A[i][r] = g->parent[i] < 0 ? (D){0} : A[g->parent[i]][r];
          if (g->coordinate[i] == c) A[i][r] += rigid->body[i].S[r];
        }
      }
      unit_torques(g, rigid, n, k, A, 1, torque);
      for (int r = 0; r < n; r++) dM[c * n + r] = torque[r][0];
    }
    for (int j = 0; j < n; j++) {
      double x = 0;
      for (int c = 0; c < n; c++)
        for (int r = 0; r < n; r++) x -= M[j * n + c] * dM[c * n + r] * M[r * n + j];
      by[k * n + j] = x / M[j * n + j];
    }
    for (int p = 0; p < w->pairs; p++) {
      double x = 0;
      for (int c = 0; c < n; c++)
        for (int r = 0; r < n; r++) x -= turn[p][c] * dM[c * n + r] * turn[p][r];
      by_pair[k * w->pairs + p] = x / w->pair_weight[p];
    }
  }
}

INLINE void driven(const Given *g, Work *w, const int n, const int want) {
  for (int j = 0; j < n; j++) w->motor[j] = 0;
  for (long d = 0; d < g->nu; d++) {
    const double *way = g->way + d * n;
    double length = 0, rate = 0;
    for (int j = 0; j < n; j++) length += way[j] * w->q[j], rate += way[j] * w->v[j];
    double u = w->u[d], uu = 1;
    if (u < DN(FROM)) u = DN(FROM), uu = 0;
    if (u > DN(TO)) u = DN(TO), uu = 0;
    const double scale = DN(SCALE), gain = DN(GAIN0) + DN(GAIN1) * length;
    const double drawn = gain * u + DN(BIAS1) * length;
    double force = DN(BIAS0) + scale * drawn, open = 1, band = 0;
    const double idle = fabs(DN(GAIN0)) * scale * DN(DEAD);
    if (idle > 0 && fabs(force) < idle) force = 0, open = 0;
    else if (DN(DEAD) > 0 || want) band = force > 0 ? -1 : force < 0 ? 1 : 0, force += band * idle;
    const double slope = DN(BIAS2) + DN(GAIN2) * u;
    int volt = 0, limit = 0;
    if (force > DN(VOLTAGE)) force = DN(VOLTAGE), volt = 1;
    if (force < -DN(VOLTAGE)) force = -DN(VOLTAGE), volt = -1;
    force += slope * rate;
    if (force >= DN(STRONGEST)) force = DN(STRONGEST), limit = 1;
    if (force <= DN(WEAKEST)) force = DN(WEAKEST), limit = -1;
    for (int j = 0; j < n; j++) w->motor[j] += way[j] * force;
    w->inside[d] = !limit;
    w->slope[d] = limit ? 0 : slope;
    if (!want) continue;
    const double through = limit || volt ? 0 : open;
    w->volt[d] = limit ? 0 : volt;
    w->limit[d] = limit;
    w->length[d] = length;
    w->rate[d] = rate;
    w->by_length[d] = through * scale * (DN(GAIN1) * u + DN(BIAS1));
    w->by_rate[d] = limit ? 0 : slope;
    w->by_u[d] = uu * (through * scale * gain + (limit ? 0 : DN(GAIN2) * rate));
    w->by_scale[d] = through * (drawn + band * fabs(DN(GAIN0)) * DN(DEAD));
    w->by_gain[d] = through * scale * (u - length + band * DN(DEAD));
    w->by_band[d] = through * band * fabs(DN(GAIN0)) * scale;
    w->faster[d] *= uu;
  }
}

INLINE void limited(const Given *g, const int n, const int j, double distance, double rate, double weight, Side *one) {
  one->pull = -INFINITY, one->soft = 1, one->by = 0, one->by_rate = 0, one->log_soft = 0;
  if (!(distance < JN(MARGIN))) return;
  const double depth = distance - JN(MARGIN), middle = JN(MIDDLE), power = JN(POWER), high = JN(HIGHEST);
  double x = fabs(depth) / JN(WIDTH), curve, steep, inner = 1;
  if (x >= 1) x = 1, inner = 0;
  if (power == 1) curve = x, steep = 1;
  else if (x <= middle) curve = pow(x, power) / pow(middle, power - 1), steep = power * pow(x / middle, power - 1);
  else curve = 1 - pow(1 - x, power) / pow(1 - middle, power - 1), steep = power * pow((1 - x) / (1 - middle), power - 1);
  const double impedance = JN(LOWEST) + curve * (high - JN(LOWEST));
  const double rise = inner * steep * (high - JN(LOWEST)) * (depth < 0 ? -1 : 1) / JN(WIDTH);
  const double time = JN(TIME), safe = time > 2 * g->dt ? time : 2 * g->dt;
  double stiff, damp;
  if (time <= 0) stiff = -time / (high * high), damp = -JN(DAMPED) / high;
  else stiff = 1 / (high * safe * JN(DAMPED) * high * safe * JN(DAMPED)), damp = 2 / (high * safe);
  one->pull = -damp * rate - stiff * impedance * depth;
  one->soft = (1 - impedance) / impedance * weight;
  one->by = -stiff * (impedance + rise * depth);
  one->by_rate = -damp;
  one->log_soft = -rise / (impedance * (1 - impedance));
}

ALIKE void resisted(const Given *g, Work *w, const int n) {
  for (int j = 0; j < n; j++) {
    const double v = w->v[j], q = w->q[j], motor = w->motor[j];
    double total = motor;
    w->within[j] = 1;
    if (motor < JN(LEAST)) total = JN(LEAST), w->within[j] = 0;
    if (motor > JN(LARGEST)) total = JN(LARGEST), w->within[j] = 0;
    w->motor[j] = total;
    double stretch = q - JN(REST), half = JN(PLAY) / 2;
    stretch = stretch > half ? stretch - half : stretch < -half ? stretch + half : 0;
    double passive = JN(DAMPING) * v + JN(STIFFNESS) * stretch + JN(OFFSET);
    if (JN(SINE) != 0 || JN(COSINE) != 0) passive += JN(SINE) * sin(JN(ORDER) * q) + JN(COSINE) * cos(JN(ORDER) * q);
    w->torque[j] = total - passive;
    double level = JN(FRICTION);
    w->peak[j] = 0;
    if (JN(PEAK) != 0) w->peak[j] = exp(-(v / JN(SPEED)) * (v / JN(SPEED))), level += JN(PEAK) * w->peak[j];
    if (JN(RATIO) != 0) level += JN(RATIO) * fabs(total + w->bias[j]);
    w->level[j] = level > 0 ? level : 0;
    w->pull[j] = g->hard ? -v / g->dt : -JN(RATE) * v;
    w->soft[j] = w->weight[j] * (g->hard ? 1e-9 : JN(SHARE));
    if (!g->limited) continue;
    limited(g, n, j, q - JN(LOWER), v, w->weight[j], &w->side[0][j]);
    limited(g, n, j, JN(UPPER) - q, -v, w->weight[j], &w->side[1][j]);
  }
  for (int k = 0; k < w->pairs; k++) {
    const int i = w->one[k], j = w->two[k];
    const double s = w->way[k], rate = w->v[i] + s * w->v[j];
    w->torque[i] -= PN(DRAG) * s * w->v[j], w->torque[j] -= PN(DRAG) * s * w->v[i];
    w->pair_level[k] = PN(RUB) > 0 ? PN(RUB) : 0;
    w->pair_pull[k] = g->hard ? -rate / g->dt : -g->joint[RATE * n + i] * rate;
    w->pair_soft[k] = w->pair_weight[k] * (g->hard ? 1e-9 : g->joint[SHARE * n + i]);
  }
  for (long d = 0; d < g->nu; d++) { /* as MuJoCo: not where the one joint of a drive is at the end of its torque range */
    const double *way = g->way + d * n;
    int one = 0, many = 0;
    for (int j = 0; j < n; j++)
      if (way[j] != 0) one = j, many++;
    w->stepped[d] = w->inside[d] && (many != 1 || w->within[one]);
    if (!w->stepped[d]) w->slope[d] = 0;
  }
}

INLINE void acting(const Given *g, Work *w, const int n, const double *a) {
  for (int j = 0; j < n; j++) {
    const double raw = (w->pull[j] - a[j]) / w->soft[j];
    w->slip[j] = raw >= w->level[j] ? 1 : raw <= -w->level[j] ? -1 : 0;
    w->side[0][j].on = g->limited && a[j] < w->side[0][j].pull;
    w->side[1][j].on = g->limited && -a[j] < w->side[1][j].pull;
  }
  for (int k = 0; k < w->pairs; k++) {
    const double raw = (w->pair_pull[k] - a[w->one[k]] - w->way[k] * a[w->two[k]]) / w->pair_soft[k];
    w->held[k] = raw >= w->pair_level[k] ? 1 : raw <= -w->pair_level[k] ? -1 : 0;
  }
}
INLINE double pair_force(const Work *w, const int k, const double *a) {
  if (w->held[k]) return w->held[k] * w->pair_level[k];
  return (w->pair_pull[k] - a[w->one[k]] - w->way[k] * a[w->two[k]]) / w->pair_soft[k];
}
INLINE double force_at(const Work *w, const int j, double a) {
  double f = w->slip[j] ? w->slip[j] * w->level[j] : (w->pull[j] - a) / w->soft[j];
  if (w->side[0][j].on) f += (w->side[0][j].pull - a) / w->side[0][j].soft;
  if (w->side[1][j].on) f -= (w->side[1][j].pull + a) / w->side[1][j].soft;
  return f;
}
INLINE double stiffness(const Work *w, const int j) {
  double s = w->slip[j] ? 0 : 1 / w->soft[j];
  for (int k = 0; k < 2; k++)
    if (w->side[k][j].on) s += 1 / w->side[k][j].soft;
  return s;
}

/* slope of the cost along a way; sets the forces that act there */
APART double along(const Given *g, Work *w, const int n, const double *a, const double *way, double s, double start, double curve) {
  double at[MOST], x = start + s * curve;
  for (int j = 0; j < n; j++) at[j] = a[j] + s * way[j];
  acting(g, w, n, at);
  for (int j = 0; j < n; j++) x -= way[j] * force_at(w, j, at[j]);
  for (int k = 0; k < w->pairs; k++) x -= (way[w->one[k]] + w->way[k] * way[w->two[k]]) * pair_force(w, k, at);
  return x;
}
APART double step_length(const Given *g, Work *w, const int n, const double *r, const double *way) {
  double at[4 * MOST + 2 * PAIRS + 2], start = 0, curve = 0, far = 0, low = 0, high = INFINITY;
  int many = 0;
  for (int j = 0; j < n; j++) {
    double x = 0, y = 0;
    for (int k = 0; k < n; k++) x += w->M[j * n + k] * w->a[k], y += w->M[j * n + k] * way[k];
    start += way[j] * (x - r[j]), curve += way[j] * y;
    if (way[j] == 0) continue;
    const double reach = w->soft[j] * w->level[j];
    const double edge[4] = {w->pull[j] - reach, w->pull[j] + reach, w->side[0][j].pull, -w->side[1][j].pull};
    for (int k = 0; k < (g->limited ? 4 : 2); k++) {
      const double s = (edge[k] - w->a[j]) / way[j];
      if (isfinite(s) && s > 0) at[many++] = s, far = s > far ? s : far;
    }
  }
  for (int k = 0; k < w->pairs; k++) {
    const double rise = way[w->one[k]] + w->way[k] * way[w->two[k]], here = w->a[w->one[k]] + w->way[k] * w->a[w->two[k]];
    if (rise == 0) continue;
    for (int side = -1; side < 2; side += 2) {
      const double s = (w->pair_pull[k] + side * w->pair_soft[k] * w->pair_level[k] - here) / rise;
      if (isfinite(s) && s > 0) at[many++] = s, far = s > far ? s : far;
    }
  }
  at[many++] = far + 1;
  for (int k = 0; k < many; k++) {
    if (at[k] <= low || at[k] >= high) continue;
    if (along(g, w, n, w->a, way, at[k], start, curve) <= 0) low = at[k];
    else high = at[k];
  }
  if (!isfinite(high)) high = low + 1;
  const double a = along(g, w, n, w->a, way, low, start, curve), b = along(g, w, n, w->a, way, high, start, curve);
  return b > a ? low - a * (high - low) / (b - a) : low;
}

INLINE void with_stiffness(const Work *w, const int n, double *K) {
  memcpy(K, w->M, sizeof(double) * n * n);
  for (int j = 0; j < n; j++) K[j * n + j] += stiffness(w, j);
  for (int k = 0; k < w->pairs; k++) {
    if (w->held[k]) continue;
    const int i = w->one[k], j = w->two[k];
    const double c = 1 / w->pair_soft[k], s = w->way[k];
    K[i * n + i] += c, K[j * n + j] += c, K[i * n + j] += s * c, K[j * n + i] += s * c;
  }
  inverted(K, n);
}

/* accelerations of the constrained joints, the forces that act, and the inverse of masses and their stiffness */
INLINE void settled(const Given *g, Work *w, const int n) {
  double r[MOST];
  for (int j = 0; j < n; j++) r[j] = w->torque[j] - w->bias[j];
  if (n == 1) {
    double best = 0;
    int slip = 0, set = 0;
    for (int k = 0; k < (g->limited ? 3 : 1); k++) {
      double mass = w->M[0], right = r[0];
      const Side *one = k ? &w->side[k - 1][0] : 0;
      if (k && one->pull == -INFINITY) continue;
      if (k) mass += 1 / one->soft, right += (k == 1 ? one->pull : -one->pull) / one->soft;
      double raw = (w->pull[0] - right / mass) / (w->soft[0] + 1 / mass);
      const int now = raw >= w->level[0] ? 1 : raw <= -w->level[0] ? -1 : 0;
      const double a = (right + (now ? now * w->level[0] : raw)) / mass;
      if (k && !((a < w->side[0][0].pull) == (k == 1) && (-a < w->side[1][0].pull) == (k == 2))) continue;
      best = a, slip = now, set = k;
    }
    w->a[0] = best, w->slip[0] = slip, w->side[0][0].on = set == 1, w->side[1][0].on = set == 2;
    w->K[0] = 1 / (w->M[0] + stiffness(w, 0));
    return;
  }
  /* the first turn takes what slipped and what was met in the step before: mostly it still does */
  for (int turn = 0; turn < TURNS; turn++) {
    if (turn == 1) acting(g, w, n, w->a);
    double way[MOST], gap[MOST], full[MOST];
    int slip[MOST], low[MOST], high[MOST], held[PAIRS], same = 1;
    with_stiffness(w, n, w->K);
    for (int j = 0; j < n; j++) {
      gap[j] = -r[j] - force_at(w, j, w->a[j]);
      for (int k = 0; k < n; k++) gap[j] += w->M[j * n + k] * w->a[k];
      slip[j] = w->slip[j], low[j] = w->side[0][j].on, high[j] = w->side[1][j].on;
    }
    for (int k = 0; k < w->pairs; k++) {
      const double f = pair_force(w, k, w->a);
      gap[w->one[k]] -= f, gap[w->two[k]] -= w->way[k] * f, held[k] = w->held[k];
    }
    for (int j = 0; j < n; j++) {
      way[j] = 0;
      for (int k = 0; k < n; k++) way[j] -= w->K[j * n + k] * gap[k];
      full[j] = w->a[j] + way[j];
    }
    acting(g, w, n, full);
    for (int j = 0; j < n; j++) same &= slip[j] == w->slip[j] && low[j] == w->side[0][j].on && high[j] == w->side[1][j].on;
    for (int k = 0; k < w->pairs; k++) same &= held[k] == w->held[k];
    if (same) {
      memcpy(w->a, full, sizeof(double) * n);
      return;
    }
    if (turn == 0) continue;
    const double s = step_length(g, w, n, r, way);
    if (!isfinite(s)) {
      for (int j = 0; j < n; j++) w->a[j] = NAN;
      return;
    }
    for (int j = 0; j < n; j++) w->a[j] += s * way[j];
    acting(g, w, n, w->a);
  }
}

/* masses and bias of the rigid bodies at q, v */
APART void weighed(const Given *g, Rigid *r, const int n, const int want) {
  posed(g, r, n, r->q, r->v);
  if (want)
    for (int i = 0; i < n; i++) momentum_slope(r->body + i);
  summed_up(g, r, n, 1);
  for (int i = 0; i < n; i++) r->bias[g->coordinate[i]] = dot6(r->body[i].S, r->body[i].F);
  masses(g, r, n, r->M);
}

/* one step from q, v: `want` keeps what the derivatives need */
INLINE void stepped(const Given *g, const Rigid *rigid, const int lane, Work *w, const int n, const int carried, const int want) {
  if (carried) {
    double q = 0;
    for (int j = 0; j < n; j++) q += w->q[j];
    for (int j = 0; j < n; j++) w->bias[j] = w->base + w->steep * (q - w->at);
    for (int k = 0; k < n * n; k++) w->M[k] = w->mass;
  } else {
    for (int j = 0; j < n; j++) w->bias[j] = rigid->bias[j][lane];
    for (int k = 0; k < n * n; k++) w->M[k] = rigid->M[k][lane];
  }
  for (int j = 0; j < n; j++) w->M[j * n + j] += JN(ARMATURE);
  for (int k = 0; k < w->pairs; k++) {
    const int i = w->one[k], j = w->two[k];
    w->M[i * n + j] += w->way[k] * PN(TOGETHER), w->M[j * n + i] += w->way[k] * PN(TOGETHER);
  }
  driven(g, w, n, want);
  resisted(g, w, n);
  settled(g, w, n);
  int damped = 0;
  memset(w->D, 0, sizeof(double) * n * n);
  for (int j = 0; g->drag && j < n; j++) w->D[j * n + j] = JN(DAMPING), damped |= JN(DAMPING) != 0;
  for (int k = 0; g->drag && k < w->pairs; k++) {
    const int i = w->one[k], j = w->two[k];
    w->D[i * n + j] += w->way[k] * PN(DRAG), w->D[j * n + i] += w->way[k] * PN(DRAG), damped |= PN(DRAG) != 0;
  }
  for (long d = 0; g->implicit && d < g->nu; d++) {
    const double *way = g->way + d * n;
    if (w->slope[d] == 0) continue;
    damped = 1;
    for (int j = 0; j < n; j++) {
      if (way[j] == 0) continue;
      for (int k = 0; k < n; k++) w->D[j * n + k] -= way[j] * way[k] * w->slope[d];
    }
  }
  if (!damped && !want) {
    memcpy(w->moved, w->a, sizeof(double) * n);
    return;
  }
  double force[MOST];
  for (int k = 0; k < n * n; k++) w->L[k] = w->M[k] + g->dt * w->D[k];
  inverted(w->L, n);
  for (int j = 0; j < n; j++) {
    force[j] = 0;
    for (int k = 0; k < n; k++) force[j] += w->M[j * n + k] * w->a[k];
  }
  for (int j = 0; j < n; j++) {
    w->moved[j] = 0;
    for (int k = 0; k < n; k++) w->moved[j] += w->L[j * n + k] * force[k];
  }
}

/* derivatives of the rigid body's torques by q and v at accelerations A (those of the base included where `moving`) */
APART void slopes(const Given *g, const Rigid *w, const int n, D A[][6], D F[][6], int moving, D *by_q, D *by_v) {
  const D none = {0}, zero[6] = {none};
  const D ground[6] = {none, none, none, none - g->gravity[0], none - g->gravity[1], none - g->gravity[2]};
  D U[MOST][6];
  memset(by_q, 0, sizeof(D) * n * n);
  if (by_v) memset(by_v, 0, sizeof(D) * n * n);
  for (int i = 0; i < n; i++) {
    const long up = g->parent[i];
    crossed(up < 0 ? (moving ? ground : zero) : A[up], w->body[i].S, U[i]);
    if (!moving) continue;
    D x[6];
    crossed(up < 0 ? zero : w->body[up].V, w->body[i].T, x);
    for (int k = 0; k < 6; k++) U[i][k] += x[k];
  }
  for (int i = 0; i < n; i++) {
    const Body *b = w->body + i;
    const D *f = b->P + 3;
    D z[6], y[6], x[6], t[3], y2[6];
    inertial(b->m, b->h, b->J, b->S, z);
    inertial(b->m, b->h, b->J, U[i], y);
    crossed_force(b->S, F[i], x);
    for (int k = 0; k < 6; k++) y[k] += x[k];
    if (moving) {
      TURNED(b->B, b->T, x);
      cross(f, b->T, x + 3);
      for (int k = 0; k < 3; k++) y[k] += x[k], y[3 + k] -= 2 * x[3 + k];
      cross(f, b->S + 3, t);
      for (int k = 0; k < 3; k++) t[k] = 2 * t[k] + b->B[k] * b->S[0] + b->B[3 + k] * b->S[1] + b->B[6 + k] * b->S[2];
      if (by_v) {
        inertial(b->m, b->h, b->J, b->T, y2);
        TURNED(b->B, b->S, x);
        cross(f, b->S, x + 3);
        for (int k = 0; k < 3; k++) y2[k] = 2 * y2[k] + x[k], y2[3 + k] = 2 * (y2[3 + k] - x[3 + k]);
      }
    }
    const long r = g->coordinate[i];
    for (long j = i; j >= 0; j = g->parent[j]) {
      const long c = g->coordinate[j];
      const Body *o = w->body + j;
      by_q[r * n + c] = dot6(z, U[j]) + (moving ? dot3(t, o->T) : none);
      if (j != i) by_q[c * n + r] = dot6(o->S, y);
      if (!by_v) continue;
      by_v[r * n + c] = 2 * dot6(z, o->T) + dot3(t, o->S);
      if (j != i) by_v[c * n + r] = dot6(o->S, y2);
    }
  }
}

/* accelerations of the bodies from those of the joints, and the forces that they take, with all that is carried */
APART void spread(const Given *g, const Rigid *w, const int n, const D *a, D A[][6], D F[][6]) {
  for (int i = 0; i < n; i++) {
    const Body *b = w->body + i;
    for (int k = 0; k < 6; k++) A[i][k] = (g->parent[i] < 0 ? (D){0} : A[g->parent[i]][k]) + b->S[k] * a[g->coordinate[i]];
    inertial(b->mass, b->own, b->own + 3, A[i], F[i]);
  }
  for (int i = n - 1; i >= 0; i--)
    if (g->parent[i] >= 0)
      for (int k = 0; k < 6; k++) F[g->parent[i]][k] += F[i][k];
}

/* slopes of the rigid bodies' torques, and those of a unit of each of its unknowns; `loaded`: friction follows the load */
APART void sloped(const Given *g, Rigid *r, const int n, const int loaded) {
  D A[MOST][6], F[MOST][6], X[MOST][6], G[MOST][6], idle[MOST][6];
  spread(g, r, n, r->a, A, F);
  for (int i = 0; i < n; i++)
    for (int k = 0; k < 6; k++) idle[i][k] = r->body[i].A[k], A[i][k] += r->body[i].A[k], F[i][k] += r->body[i].F[k];
  slopes(g, r, n, A, F, 1, r->by_q, r->by_v);
  spread(g, r, n, r->moved, X, G);
  slopes(g, r, n, X, G, 0, r->second, 0);
  if (loaded) {
    for (int i = 0; i < n; i++) memcpy(F[i], r->body[i].F, sizeof F[i]);
    slopes(g, r, n, idle, F, 1, r->idle_q, r->idle_v);
  }
  for (long k = 0; k < g->many; k++) {
    if (g->kind[k] < BODY) continue;
    unit_torques(g, r, n, k, A, 0, r->unit + 3 * k * n);
    unit_torques(g, r, n, k, X, 1, r->unit + (3 * k + 1) * n);
    if (loaded) unit_torques(g, r, n, k, idle, 0, r->unit + (3 * k + 2) * n);
  }
}

#define BY(c) by[(c) * n + j] /* columns first */

/* derivatives of the step's acceleration by q, v and the unknowns: (2 n + many, n) */
INLINE void linearised(const Given *g, const Rigid *rigid, const int lane, Work *w, const int n, const int carried, const double *mobile, double *by) {
  const int two = 2 * n, total = two + (int)g->many;
  double first[MOST * MOST * 2], second[MOST * MOST], own[MOST * MOST], W[MOST * MOST], x[MOST], load[MOST], sign[MOST];
  int loaded = 0;
  for (int j = 0; j < n; j++) {
    x[j] = w->moved[j] - w->a[j];
    sign[j] = 0;
    if (w->slip[j] && JN(RATIO) != 0 && w->level[j] > 0) sign[j] = w->slip[j] * JN(RATIO) * (w->motor[j] + w->bias[j] > 0 ? 1 : -1);
    loaded |= sign[j] != 0;
    load[j] = 1 + sign[j]; /* a torque of the drive also raises the friction */
  }
  double *by_q = first, *by_v = first + n * n;
  if (carried) {
    for (int k = 0; k < n * n; k++) by_q[k] = w->steep, by_v[k] = 0, second[k] = 0;
    for (int j = 0; j < n; j++)
      for (int k = 0; k < n; k++) by_q[j * n + k] -= sign[j] * w->steep;
  } else {
    for (int k = 0; k < n * n; k++) by_q[k] = rigid->by_q[k][lane], by_v[k] = rigid->by_v[k][lane], second[k] = rigid->second[k][lane];
    for (int j = 0; j < n && loaded; j++)
      for (int k = j * n; k < (j + 1) * n; k++) by_q[k] -= sign[j] * rigid->idle_q[k][lane], by_v[k] -= sign[j] * rigid->idle_v[k][lane];
  }
  for (long d = 0; d < g->nu; d++) {
    const double *way = g->way + d * n;
    for (int j = 0; j < n; j++) {
      const double f = way[j] * load[j] * w->within[j];
      if (f == 0) continue;
      for (int k = 0; k < n; k++) by_q[j * n + k] -= f * way[k] * w->by_length[d], by_v[j * n + k] -= f * way[k] * w->by_rate[d];
    }
  }
  for (int j = 0; j < n; j++) {
    const double q = w->q[j], v = w->v[j], half = JN(PLAY) / 2, out = q - JN(REST);
    double dq = out > half || out < -half || half == 0 ? JN(STIFFNESS) : 0, dv = JN(DAMPING);
    if (JN(SINE) != 0 || JN(COSINE) != 0)
      dq += JN(ORDER) * (JN(SINE) * cos(JN(ORDER) * q) - JN(COSINE) * sin(JN(ORDER) * q));
    if (w->slip[j] == 0) dv += (g->hard ? 1 / g->dt : JN(RATE)) / w->soft[j];
    else if (w->level[j] > 0) dv += w->slip[j] * JN(PEAK) * w->peak[j] * 2 * v / (JN(SPEED) * JN(SPEED));
    for (int k = 0; k < 2; k++) {
      const Side *one = &w->side[k][j];
      if (!one->on) continue;
      const double f = (one->pull + (k ? w->a[j] : -w->a[j])) / one->soft;
      dq -= one->by / one->soft - f * one->log_soft;
      dv -= one->by_rate / one->soft;
    }
    by_q[j * n + j] += dq, by_v[j * n + j] += dv;
  }
  for (int k = 0; k < w->pairs; k++) {
    const int i = w->one[k], j = w->two[k];
    const double s = w->way[k], c = w->held[k] ? 0 : (g->hard ? 1 / g->dt : g->joint[RATE * n + i]) / w->pair_soft[k];
    by_v[i * n + i] += c, by_v[j * n + j] += c, by_v[i * n + j] += s * (c + PN(DRAG)), by_v[j * n + i] += s * (c + PN(DRAG));
  }
  memset(own, 0, sizeof(double) * n * n), memset(W, 0, sizeof(double) * n * n); /* W: L M K transposed, all symmetric */
  for (int i = 0; i < n; i++)
    for (int k = 0; k < n; k++)
      for (int j = 0; j < n; j++) own[i * n + j] += w->M[i * n + k] * w->L[k * n + j];
  for (int i = 0; i < n; i++)
    for (int k = 0; k < n; k++)
      for (int j = 0; j < n; j++) W[i * n + j] += w->K[i * n + k] * own[k * n + j];
  memset(by, 0, sizeof(double) * total * n);
  for (int c = 0; c < n; c++)
    for (int k = 0; k < n; k++) {
      const double f1 = by_q[k * n + c], f2 = second[k * n + c], f3 = by_v[k * n + c];
      for (int j = 0; j < n; j++) BY(c) -= W[k * n + j] * f1 + w->L[k * n + j] * f2, BY(n + c) -= W[k * n + j] * f3;
    }
  const double drag = g->drag ? g->dt : 0;
  for (long p = 0; p < g->many; p++) {
    const long c = two + g->column[p], at = g->place[p], kind = g->kind[p];
    double one[MOST], more[MOST];
    int all = 0;
    if (kind == ARMATURE || kind >= BODY || (kind >= PAIR && kind <= PAIR + RUB)) {
      memset(one, 0, sizeof(double) * n), memset(more, 0, sizeof(double) * n);
      all = 1;
    }
    if (kind == ARMATURE) one[at] = w->a[at], more[at] = x[at];
    if (kind >= PAIR && kind <= PAIR + RUB) {
      int k = 0;
      while (w->which[k] != at) k++;
      const int i = w->one[k], j = w->two[k];
      const double s = w->way[k];
      if (kind == PAIR + TOGETHER) one[i] = s * w->a[j], one[j] = s * w->a[i], more[i] = s * x[j], more[j] = s * x[i];
      if (kind == PAIR + DRAG) {
        one[i] = s * w->v[j], one[j] = s * w->v[i], more[i] = drag * s * w->moved[j], more[j] = drag * s * w->moved[i];
      }
      if (kind == PAIR + RUB) one[i] = -w->held[k], one[j] = -s * w->held[k];
    }
    if (kind == CARRIED_BODY) {
      double q = -w->at, a = 0, s = 0;
      for (int k = 0; k < n; k++) q += w->q[k], a += w->a[k], s += x[k];
      const double bias = w->more[(3 * at + 1) * g->windows] + w->more[(3 * at + 2) * g->windows] * q;
      const double mass = w->more[3 * at * g->windows];
      for (int j = 0; j < n; j++) one[j] = mass * a + bias * (1 - sign[j]), more[j] = mass * s;
    } else if (kind >= BODY) {
      const D *unit = rigid->unit + 3 * p * n;
      for (int j = 0; j < n; j++) one[j] = unit[j][lane] - (loaded ? sign[j] * unit[2 * n + j][lane] : 0), more[j] = unit[n + j][lane];
    }
    if (all) {
      for (int j = 0; j < n; j++) { /* the constraints' softness follows the masses */
        if (mobile[p * n + j] == 0) continue;
        double f = w->slip[j] ? 0 : (w->pull[j] - w->a[j]) / w->soft[j];
        if (w->side[0][j].on) f += (w->side[0][j].pull - w->a[j]) / w->side[0][j].soft;
        if (w->side[1][j].on) f -= (w->side[1][j].pull + w->a[j]) / w->side[1][j].soft;
        one[j] += f * mobile[p * n + j];
      }
      for (int k = 0; k < w->pairs; k++) {
        const double f = w->held[k] ? 0 : (w->pair_pull[k] - w->a[w->one[k]] - w->way[k] * w->a[w->two[k]]) / w->pair_soft[k];
        const double rise = f * mobile[n * g->many + p * w->pairs + k];
        one[w->one[k]] += rise, one[w->two[k]] += w->way[k] * rise;
      }
      for (int k = 0; k < n; k++)
        for (int j = 0; j < n; j++) BY(c) -= W[k * n + j] * one[k] + w->L[k * n + j] * more[k];
      continue;
    }
    if (kind >= OF_DRIVE) {
      const long d = at;
      const double *way = g->way + d * n;
      double f = 0, bend = 0;
      if (kind == OF_DRIVE + SCALE) f = w->by_scale[d];
      if (kind == OF_DRIVE + DELAY) f = w->by_u[d] * w->faster[d], bend = w->stepped[d] * DN(GAIN2) * w->faster[d];
      if (kind == OF_DRIVE + DEAD) f = w->by_band[d];
      if (kind == OF_DRIVE + VOLTAGE) f = w->volt[d];
      if (kind == LIMIT) f = w->limit[d];
      if (kind == KP) f = w->by_gain[d];
      if (kind == KD) f = w->inside[d] ? -w->rate[d] : 0, bend = w->stepped[d] ? -1 : 0;
      double turn = 0;
      for (int k = 0; k < n; k++) turn += way[k] * w->moved[k];
      for (int k = 0; k < n; k++) {
        if (way[k] == 0) continue;
        const double t1 = -way[k] * f * load[k] * w->within[k], t2 = g->implicit ? -g->dt * way[k] * turn * bend : 0;
        for (int j = 0; j < n; j++) BY(c) -= W[k * n + j] * t1 + w->L[k * n + j] * t2;
      }
      continue;
    }
    double t1 = 0, t2 = 0;
    {
      const int j = (int)at;
      const double q = w->q[j], v = w->v[j], half = JN(PLAY) / 2, out = q - JN(REST);
      const int far = out > half ? 1 : out < -half ? -1 : 0;
      const double slip = w->level[j] > 0 || JN(FRICTION) + JN(PEAK) >= 0 ? w->slip[j] : 0;
      switch (kind) {
        case DAMPING: t1 = v, t2 = drag * w->moved[j]; break;
        case FRICTION: t1 = -slip; break;
        case PEAK: t1 = -slip * exp(-(v / JN(SPEED)) * (v / JN(SPEED))); break;
        case SPEED: t1 = -slip * JN(PEAK) * w->peak[j] * 2 * v * v / (JN(SPEED) * JN(SPEED) * JN(SPEED)); break;
        case RATIO: t1 = -slip * fabs(w->motor[j] + w->bias[j]); break;
        case STIFFNESS: t1 = out - far * half - (far ? 0 : out); break;
        case REST: t1 = far || half == 0 ? -JN(STIFFNESS) : 0; break;
        case PLAY: t1 = -far * JN(STIFFNESS) / 2; break;
        case OFFSET: t1 = 1; break;
        case SINE: t1 = sin(JN(ORDER) * q); break;
        case COSINE: t1 = cos(JN(ORDER) * q); break;
        case ORDER: t1 = q * (JN(SINE) * cos(JN(ORDER) * q) - JN(COSINE) * sin(JN(ORDER) * q)); break;
        default: break;
      }
    }
    for (int j = 0; j < n; j++) BY(c) -= W[at * n + j] * t1 + w->L[at * n + j] * t2;
  }
}

/* what the drives see at a step, and its derivative by the delay: `least` is the first step whose command is known */
INLINE void commanded(const Given *g, Work *w, const long window, const long step, const long least) {
  for (long d = 0; d < g->nu; d++) {
    int now = (int)step - w->whole[d], before = now - 1;
    if (now < least) now = (int)least;
    if (before < least) before = (int)least;
    const unsigned each = (unsigned)g->substeps;
    const double a = g->command[((unsigned)now / each * g->nu + d) * g->windows + window];
    const double b = g->command[((unsigned)before / each * g->nu + d) * g->windows + window];
    w->u[d] = a + w->part[d] * (b - a);
    w->faster[d] = (b - a) * w->often;
  }
}

INLINE void carrying(const Given *g, Work *w, const long window, const long row) {
  const long wide = 4 + 3 * g->links;
  const double *one = g->load + row * wide * g->windows + window;
  w->mass = one[0], w->base = one[g->windows], w->steep = one[2 * g->windows], w->at = one[3 * g->windows];
  w->more = one + 4 * g->windows;
  for (long k = 0; k < g->links; k++) {
    if (g->payload[k] == 0) continue;
    w->mass += g->payload[k] * w->more[3 * k * g->windows];
    w->base += g->payload[k] * w->more[(3 * k + 1) * g->windows];
    w->steep += g->payload[k] * w->more[(3 * k + 2) * g->windows];
  }
}

/* what is read: positions, then rates */
INLINE double seen(const Given *g, const Work *w, const int n, const long y) {
  const int j = (int)g->measured[y % g->ny];
  return y < g->ny ? w->q[j] + JN(READING) : w->v[j];
}

/* rows of weighed sensitivities that wait to be multiplied with themselves */
enum { KEPT = 64 };
typedef double V __attribute__((vector_size(64), aligned(8)));
WIDE void multiplied(const long width, const long many, const double *restrict kept, double *restrict matrix) {
  for (long c = 0; c < width; c += 4) /* four rows of the matrix, its upper half */
    for (long r = c / 8 * 8; r < width; r += 8) {
      V sum[4] = {{0}};
      for (long k = 0; k < many; k++) {
        const double *row = kept + k * width;
        const V x = *(const V *)(row + r);
        for (int i = 0; i < 4; i++) sum[i] += row[c + i] * x;
      }
      for (int i = 0; i < 4; i++) *(V *)(matrix + (c + i) * width + r) += sum[i];
    }
}

/* the row before, of each number that is read: its error and its sensitivities */
typedef struct {
  double error[ROWS], *slope;
  int had[ROWS];
} Before;

/* what a row tells beyond the row before it, where the noise is a first-order low pass */
INLINE double beyond(const double pole, const long width, const long y, double error, double *restrict slope, Before *before) {
  double *restrict past = before->slope + y * width;
  const double now = error, alone = sqrt(1 - pole * pole);
  error = before->had[y] ? error - pole * before->error[y] : alone * error;
  for (long c = 0; c < width; c++) {
    const double own = slope[c];
    slope[c] = before->had[y] ? own - pole * past[c] : alone * own;
    past[c] = own;
  }
  before->error[y] = now, before->had[y] = 1;
  return error;
}

/* sums of a row: squares, gradient, and what the normal matrix will be made of */
WIDE void collected(const Given *g, const Work *w, const int n, const long window, const long row, const long width, const double *S,
                    double *cost, double *gradient, double *matrix, double *kept, long *many, Before *before) {
  const long wide = g->ny * (g->rates ? 2 : 1);
  for (long y = 0; y < wide; y++) {
    const double sure = g->weight[(row * wide + y) * g->windows + window];
    if (sure == 0) {
      before->had[y] = 0;
      continue;
    }
    double error = (g->reading[(row * wide + y) * g->windows + window] - seen(g, w, n, y)) * sure;
    const long half = y < g->ny ? 0 : n, j = g->measured[y % g->ny];
    const double *own = S + (half + j) * width;
    double *restrict slope = kept + *many * width;
    for (long c = 0; c < width; c++) slope[c] = own[c] * sure;
    if (!half)
      for (long p = 0; p < g->many; p++)
        if (g->kind[p] == READING && g->place[p] == j) slope[g->column[p]] += sure;
    if (g->pole) error = beyond(g->pole[y * g->windows + window], width, y, error, slope, before);
    cost[y] += error * error;
    for (long c = 0; c < width; c++) gradient[c] += slope[c] * error;
    if (++*many == KEPT) multiplied(width, *many, kept, matrix), *many = 0;
  }
}

/* the sensitivities after the step, eight columns at a time, which stay in registers */
WIDE void carried_on(const Given *g, const int n, const long width, const double *by, double *S) {
  const double dt = g->dt;
  double f[2 * n * n], more[n * width];
  memset(more, 0, sizeof more);
  for (int j = 0; j < n; j++) {
    for (int k = 0; k < 2 * n; k++) f[j * 2 * n + k] = dt * BY(k);
    for (long c = 0; c < g->columns; c++) more[j * width + c] = dt * BY(2 * n + c);
  }
  for (long c = 0; c < width; c += 8) {
    V old[2 * n];
    for (int k = 0; k < 2 * n; k++) old[k] = *(V *)(S + k * width + c);
    for (int j = 0; j < n; j++) {
      V v = old[n + j] + *(V *)(more + j * width + c);
      for (int k = 0; k < 2 * n; k++) v += f[j * 2 * n + k] * old[k];
      *(V *)(S + (n + j) * width + c) = v;
      *(V *)(S + j * width + c) = old[j] + dt * v;
    }
  }
}

typedef struct { /* a window with its sums and sensitivities */
  Work w;
  long window, end, waiting; /* end: of the rows that count; waiting: rows of `kept` */
  int lost, on;
  double cost[ROWS], *S, *by, *gradient, *matrix, *kept;
  Before before;
} Lane;

INLINE void begun(const Given *g, const int n, const int want, const long width, const Work *first, const long window, Lane *one) {
  const long wide = g->ny * (g->rates ? 2 : 1);
  one->w = *first, one->window = window, one->end = g->rows, one->waiting = one->lost = 0;
  for (int j = 0; j < n; j++) one->w.q[j] = g->begin[j * g->windows + window], one->w.v[j] = g->begin[(n + j) * g->windows + window];
  if (!want) return;
  memset(one->S, 0, sizeof(double) * 2 * n * width);
  memset(one->before.had, 0, sizeof one->before.had);
  for (int k = 0; k < 2 * n; k++) one->S[k * width + g->columns + k] = 1;
  for (int none = 1; none && one->end > 0; one->end -= none) /* shorter windows are padded */
    for (long y = 0; y < wide; y++) none &= g->weight[((one->end - 1) * wide + y) * g->windows + window] == 0;
}

/* the sums of a block, to where they are asked for */
WIDE void told(const Given *g, const int n, const long width, const long b, Lane *one) {
  const long wide = g->ny * (g->rates ? 2 : 1), total = g->columns + 2 * n, at = b * g->windows + one->window;
  multiplied(width, one->waiting, one->kept, one->matrix), one->waiting = 0;
  for (long y = 0; y < wide; y++) g->cost[at * wide + y] = one->lost ? NAN : one->cost[y];
  double *gradient = g->gradient + at * total, *matrix = g->matrix + at * total * total;
  for (long c = 0; c < total; c++) {
    gradient[c] = one->lost ? NAN : one->gradient[c];
    for (long r = c; r < total; r++) matrix[c * total + r] = matrix[r * total + c] = one->lost ? NAN : one->matrix[c * width + r];
  }
  memset(one->cost, 0, sizeof one->cost);
  memset(one->gradient, 0, sizeof(double) * width), memset(one->matrix, 0, sizeof(double) * width * width);
}

INLINE void row_of(const Given *g, const int n, const int carried, const int want, const long width, const long row, Lane *one) {
  const long wide = g->ny * (g->rates ? 2 : 1);
  Work *w = &one->w;
  for (int j = 0; j < n; j++) one->lost |= !(fabs(w->v[j]) < 1e12);
  one->on = row < one->end && !one->lost;
  if (!want)
    for (long y = 0; y < wide; y++) g->read[(row * wide + y) * g->windows + one->window] = one->lost ? NAN : seen(g, w, n, y);
  if (!one->on) return;
  if (want)
    collected(g, w, n, one->window, row, width, one->S, one->cost, one->gradient, one->matrix, one->kept, &one->waiting, &one->before);
  if (carried) carrying(g, w, one->window, row);
}

/* windows side by side */
INLINE void windows_of(const Given *g, const int n, const int carried, const int want, const long width, const double *mobile, Rigid *rigid, Lane *lanes) {
  const int many = rigid->lanes;
  int loaded = 0;
  for (int j = 0; j < n; j++) loaded |= JN(RATIO) != 0;
  long end = 0;
  for (int l = 0; l < many; l++) end = lanes[l].end > end ? lanes[l].end : end;
  for (long b = 0; b < g->rows / g->block; b++) {
    for (long row = b * g->block; row < (b + 1) * g->block && row < end; row++) {
      for (int l = 0; l < many; l++) row_of(g, n, carried, want, width, row, lanes + l);
      for (long k = 0; k < g->substeps; k++) {
        for (int l = 0; l < many && !carried; l++)
          for (int j = 0; j < n; j++) rigid->q[j][l] = lanes[l].w.q[j], rigid->v[j][l] = lanes[l].w.v[j];
        if (!carried) weighed(g, rigid, n, want);
        for (int l = 0; l < many; l++) {
          Work *w = &lanes[l].w;
          if (!lanes[l].on) continue;
          commanded(g, w, lanes[l].window, (row + g->lead) * g->substeps + k, b * g->block * g->substeps);
          stepped(g, rigid, l, w, n, carried, want);
          for (int j = 0; j < n && want && !carried; j++) rigid->a[j][l] = w->a[j], rigid->moved[j][l] = w->moved[j] - w->a[j];
        }
        if (want && !carried) sloped(g, rigid, n, loaded);
        for (int l = 0; l < many; l++) {
          Work *w = &lanes[l].w;
          if (!lanes[l].on) continue;
          if (want) linearised(g, rigid, l, w, n, carried, mobile, lanes[l].by), carried_on(g, n, width, lanes[l].by, lanes[l].S);
          for (int j = 0; j < n; j++) w->v[j] += g->dt * w->moved[j], w->q[j] += g->dt * w->v[j];
        }
      }
    }
    for (int l = 0; l < many && want; l++) told(g, n, width, b, lanes + l);
  }
}

INLINE void all_windows(const Given *g, const int n, const int carried, const int want) {
  Work w; /* no static one: its address would be asked for at each use */
  Rigid rigid;
  Lane lanes[LANES];
  memset(&w, 0, sizeof w), memset(&rigid, 0, sizeof rigid);
  for (long k = 0; k < g->pairs && w.pairs < PAIRS; k++) {
    int acts = g->pair[TOGETHER * g->pairs + k] != 0 || g->pair[DRAG * g->pairs + k] != 0 || g->pair[RUB * g->pairs + k] != 0;
    for (long p = 0; p < g->many; p++) acts |= g->kind[p] >= PAIR && g->kind[p] <= PAIR + RUB && g->place[p] == k;
    if (!acts) continue;
    w.one[w.pairs] = (int)g->joined[3 * k], w.two[w.pairs] = (int)g->joined[3 * k + 1];
    w.way[w.pairs] = (double)g->joined[3 * k + 2], w.which[w.pairs++] = k;
  }
  double mobile[(n + w.pairs) * g->many + 1];
  mobility(g, &rigid, &w, n, mobile);
  w.often = 1 / g->dt;
  for (long d = 0; d < g->nu; d++) {
    const double late = (DN(DELAY) > 0 ? DN(DELAY) : 0) / g->dt;
    w.whole[d] = late < 1e9 ? (int)late : 1000000000, w.part[d] = late - floor(late);
  }
  const long wide = g->ny * (g->rates ? 2 : 1), width = (g->columns + 2 * n + 7) / 8 * 8, side = g->windows < LANES ? g->windows : LANES;
  const long sizes[] = {2 * n * width, width, width * width, KEPT * width, wide * width, (2 * n + g->many) * n};
  long all = 0;
  for (int k = 0; k < 6; k++) all += (sizes[k] + 7) / 8 * 8;
  double *room = want ? aligned_alloc(64, sizeof(double) * (side * all + 3 * LANES * g->many * n)) : 0, *next = room;
  if (want) memset(room, 0, sizeof(double) * side * all);
  for (long l = 0; l < side && want; l++) {
    double **parts[] = {&lanes[l].S, &lanes[l].gradient, &lanes[l].matrix, &lanes[l].kept, &lanes[l].before.slope, &lanes[l].by};
    memset(lanes[l].cost, 0, sizeof lanes[l].cost);
    for (int k = 0; k < 6; k++) *parts[k] = next, next += (sizes[k] + 7) / 8 * 8;
  }
  rigid.unit = (D *)next;
  for (long k = 0; k < g->windows; k += LANES) {
    rigid.lanes = g->windows - k < LANES ? g->windows - k : LANES;
    for (int l = 0; l < rigid.lanes; l++) begun(g, n, want, width, &w, k + l, lanes + l);
    windows_of(g, n, carried, want, width, mobile, &rigid, lanes);
  }
  free(room);
}

long most_coordinates(void) { return MOST; }

/* SIZE: coordinates where they are few, else 0; ONE: a joint carried by a measured arm */
void rolled(const Given *g) {
  const int n = SIZE ? SIZE : (int)g->n;
  all_windows(g, n, ONE, g->cost != 0);
}
