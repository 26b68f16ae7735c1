/* Rows of postures and their derivatives: `posehost.HostRows.rows` as machine code, one posture after the other.

   The same formulas in the same order; matrices stand by rows, the postures last in all that goes out. */

#include <math.h>
#include <stddef.h>

#define MOST 64 /* joints */
#define SMALL 1e-4 /* rad^2, as in posehost */
#define INLINE static inline __attribute__((always_inline))

typedef struct {
  long samples, joints, moving, poses, body, sight, free_base, free_tool, markers;
  const double *start, *base, *origin, *centre, *tool, *arm; /* rotations (9) before the first joint, of base and tool; points */
  const double *first, *ahead, *beyond;       /* (3), (n, 3), (3) */
  const double *onward, *slide;               /* (n, samples, 9), (n, samples, 3) or none */
  const double *back, *seen, *marker;         /* (samples, 9) of poses, (samples, points, 3), (markers, 3) */
  const double *twists, *own;                 /* (n, 6, samples where they are moving, or 1), (k) */
  double *residual, *response, *by_own;       /* (rows, samples), (6 n, rows, samples), (k, rows, samples) */
} Given;

INLINE void times(const double *a, const double *b, double *c) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) c[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}
INLINE void turned(const double *a, const double *x, double *y) {
  for (int i = 0; i < 3; i++) y[i] = a[3 * i] * x[0] + a[3 * i + 1] * x[1] + a[3 * i + 2] * x[2];
}
INLINE void skew(const double *w, double *k) {
  k[0] = k[4] = k[8] = 0.0;
  k[1] = -w[2], k[2] = w[1], k[3] = w[2], k[5] = -w[0], k[6] = -w[1], k[7] = w[0];
}

/* Of columns of six rows, N apart, the last three by k added to the first */
static void mixed(double *out, long columns, long next, long N, const double *k) {
  for (long n = 0; n < columns; n++, out += next) {
    const double angle[3] = {out[3 * N], out[4 * N], out[5 * N]};
    for (int i = 0; i < 3; i++) out[i * N] += k[3 * i] * angle[0] + k[3 * i + 1] * angle[1] + k[3 * i + 2] * angle[2];
  }
}

/* sin t / t, (1 - cos t) / t^2, (t - sin t) / t^3 and the two further ones of SE(3) */
static void series(double q, double *x) {
  if (q < SMALL) {
    const double s = q * q;
    x[0] = 1.0 - q / 6.0 + s / 120.0, x[1] = 0.5 - q / 24.0 + s / 720.0;
    x[2] = 1.0 / 6.0 - q / 120.0 + s / 5040.0, x[3] = 1.0 / 24.0 - q / 720.0 + s / 40320.0;
    x[4] = 1.0 / 120.0 - q / 2520.0 + s / 120960.0;
    return;
  }
  const double t = sqrt(q), sine = sin(t), cosine = cos(t), half = sin(t / 2.0), versine = 2.0 * half * half;
  x[0] = sine / t, x[1] = versine / q, x[2] = (t - sine) / (q * t);
  x[3] = (0.5 * q - versine) / (q * q), x[4] = (2.0 * t - 3.0 * sine + t * cosine) / (2.0 * (q * q) * t);
}

/* The rotation of a rotation vector, its left Jacobian, and the coefficients of both */
static void exponential(const double *w, double *turn, double *bend, double *x) {
  double k[9], square[9];
  skew(w, k);
  times(k, k, square);
  series(w[0] * w[0] + w[1] * w[1] + w[2] * w[2], x);
  for (int i = 0; i < 9; i++) {
    turn[i] = (i % 4 == 0) + x[0] * k[i] + x[1] * square[i];
    bend[i] = (i % 4 == 0) + x[1] * k[i] + x[2] * square[i];
  }
}

typedef struct {
  double turn[9], shift[3], bend[9], mixed[9]; /* exponential of a twist; its left Jacobian (bend mixed; 0 bend) */
} Moved;

static void moved(const double *twist, Moved *m) {
  double x[5], r[9], w[9], wr[9], rw[9], wrw[9], wwr[9], rww[9], wrww[9], wwrw[9];
  exponential(twist + 3, m->turn, m->bend, x);
  turned(m->bend, twist, m->shift);
  skew(twist, r);
  skew(twist + 3, w);
  times(w, r, wr), times(r, w, rw), times(wr, w, wrw), times(w, wr, wwr), times(rw, w, rww);
  times(wrw, w, wrww), times(w, wrw, wwrw);
  for (int i = 0; i < 9; i++)
    m->mixed[i] = 0.5 * r[i] + x[2] * (wr[i] + rw[i] + wrw[i]) + x[3] * (wwr[i] + rww[i] - 3.0 * wrw[i]) +
                  x[4] * (wrww[i] + wwrw[i]);
}

/* The rotation vector of the shorter way round, from the largest entry of the unit quaternion */
static void logarithm(const double *R, double *angle) {
  const double x = R[0], y = R[4], z = R[8], a = R[7] - R[5], b = R[2] - R[6], c = R[3] - R[1];
  const double d = R[1] + R[3], e = R[2] + R[6], f = R[5] + R[7];
  const double each[4][4] = {
    {1 + x - y - z, d, e, a}, {d, 1 - x + y - z, f, b}, {e, f, 1 - x - y + z, c}, {a, b, c, 1 + x + y + z}};
  int k = 3;
  if (!(x + y + z > 0.0)) {
    k = 0;
    for (int i = 1; i < 4; i++) k = each[i][i] > each[k][k] ? i : k;
  }
  const double *v = each[k], size = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2] + v[3] * v[3]);
  const double sign = (v[3] < 0.0 ? -1.0 : 1.0) / size, w = sign * v[3];
  const double square = sign * sign * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
  double times = 2.0 / w * (1.0 - square / (3.0 * w * w) + square * square / (5.0 * w * w * w * w));
  if (!(square < SMALL)) times = 2.0 * atan2(sqrt(square), w) / sqrt(square);
  for (int i = 0; i < 3; i++) angle[i] = times * sign * v[i];
}

static void inverse_left_jacobian(const double *w, double *J) {
  const double q = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], half = 0.5 * sqrt(q);
  const double d = q < SMALL ? 1.0 / 12.0 + q / 720.0 + q * q / 30240.0 : (1.0 - half * cos(half) / sin(half)) / (4.0 * half * half);
  double k[9], square[9];
  skew(w, k);
  times(k, k, square);
  for (int i = 0; i < 9; i++) J[i] = (i % 4 == 0) - 0.5 * k[i] + d * square[i];
}

typedef struct {
  double R[9], p[3], before[MOST][9], turned[MOST][9], origin[MOST][3];
} Chain;

static void chain(const Given *g, long s, double exponent[][9], double bend[][9], Chain *c) {
  double axes[9], moving[9], slid[3] = {0.0, 0.0, 0.0}, p[3], x[5];
  for (int i = 0; i < 9; i++) axes[i] = g->start[i];
  for (int i = 0; i < 3; i++) p[i] = g->first[i];
  for (long j = 0; j < g->joints; j++) {
    const long stride = g->moving ? g->samples : 1;
    const double *twist = g->twists + 6 * j * stride + (g->moving ? s : 0);
    double shift[3], step[3];
    if (g->moving) {
      const double w[3] = {twist[3 * stride], twist[4 * stride], twist[5 * stride]};
      exponential(w, exponent[j], bend[j], x);
    }
    for (int i = 0; i < 3; i++) shift[i] = g->ahead[3 * j + i] + twist[i * stride];
    turned(axes, shift, step);
    for (int i = 0; i < 3; i++) c->origin[j][i] = p[i] += step[i] + slid[i];
    for (int i = 0; i < 9; i++) c->before[j][i] = axes[i];
    times(axes, bend[j], c->turned[j]);
    times(axes, exponent[j], moving);
    if (g->slide) turned(moving, g->slide + 3 * (j * g->samples + s), slid);
    times(moving, g->onward + 9 * (j * g->samples + s), axes);
  }
  double step[3];
  turned(axes, g->beyond, step);
  for (int i = 0; i < 3; i++) c->p[i] = p[i] + step[i] + slid[i];
  for (int i = 0; i < 9; i++) c->R[i] = axes[i];
}

/* The derivatives of a row by the joints' twists, from those by the tool's motion in the axes of the base */
INLINE void respond(const Given *g, const Chain *c, long s, long row, long rows, const double *linear, const double *angular) {
  const size_t next = (size_t)rows * g->samples;
  double *out = g->response + row * g->samples + s;
  for (long j = 0; j < g->joints; j++, out += 6 * next) {
    const double d[3] = {c->p[0] - c->origin[j][0], c->p[1] - c->origin[j][1], c->p[2] - c->origin[j][2]};
    const double about[3] = {
      angular[0] - (linear[1] * d[2] - linear[2] * d[1]), angular[1] - (linear[2] * d[0] - linear[0] * d[2]),
      angular[2] - (linear[0] * d[1] - linear[1] * d[0])};
    for (int i = 0; i < 3; i++) {
      const double *B = c->before[j], *T = c->turned[j];
      out[i * next] = linear[0] * B[i] + linear[1] * B[3 + i] + linear[2] * B[6 + i];
      out[(3 + i) * next] = about[0] * T[i] + about[1] * T[3 + i] + about[2] * T[6 + i];
    }
  }
}

/* Derivatives of a point (device axes, `away` from the centre) and of a turning by the six unknowns of the base */
static void by_base(const Moved *m, const double *away, double point[3][6], double turning[3][6]) {
  double k[9], lower[9];
  skew(away, k);
  times(k, m->bend, lower);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      point[i][j] = m->bend[3 * i + j], point[i][3 + j] = m->mixed[3 * i + j] - lower[3 * i + j];
      turning[i][j] = 0.0, turning[i][3 + j] = m->bend[3 * i + j];
    }
}

void pose_rows(const Given *g) {
  static const double unturned[9] = {1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0};
  double exponent[MOST][9], bend[MOST][9], x[5], turn[9], place[3], scratch[9], tool_turn[9], arm[3], tool_mixed[9];
  const long base = g->free_base ? 6 : 0, own = base + (g->free_tool ? (g->poses ? 6 : 3 * g->markers) : 0);
  const long rows = g->poses ? 6 : 3 * g->markers;
  const size_t N = g->samples, next = rows * N;
  Moved of_base, of_tool;
  Chain c;
  for (long j = 0; j < (g->moving ? 0 : g->joints); j++) exponential(g->twists + 6 * j + 3, exponent[j], bend[j], x);
  for (int i = 0; i < 9; i++) turn[i] = g->base[i];
  for (int i = 0; i < 3; i++) place[i] = g->origin[i];
  if (g->free_base) {
    const double lever[3] = {g->origin[0] - g->centre[0], g->origin[1] - g->centre[1], g->origin[2] - g->centre[2]};
    moved(g->own, &of_base);
    times(of_base.turn, g->base, turn);
    turned(of_base.turn, lever, place);
    for (int i = 0; i < 3; i++) place[i] += g->centre[i] + of_base.shift[i];
  }
  if (g->poses) {
    for (int i = 0; i < 9; i++) tool_turn[i] = g->tool[i];
    for (int i = 0; i < 3; i++) arm[i] = g->arm[i];
    if (g->free_tool) {
      double step[3], k[9];
      moved(g->own + base, &of_tool);
      times(g->tool, of_tool.turn, tool_turn);
      turned(g->tool, of_tool.shift, step);
      skew(of_tool.shift, k);
      times(k, of_tool.bend, scratch);
      for (int i = 0; i < 3; i++) arm[i] += step[i];
      for (int i = 0; i < 9; i++) tool_mixed[i] = of_tool.mixed[i] - scratch[i];
    }
  }
  for (long s = 0; s < g->samples; s++) {
    double point[3][6], turning[3][6], lever[3], at[3], away[3], k[9], by_turn[9], whole[9];
    chain(g, s, exponent, bend, &c);
    times(turn, c.R, whole);
    for (long m = 0; m < (g->poses ? 0 : g->markers); m++) {
      double marker[3];
      for (int i = 0; i < 3; i++) marker[i] = g->marker[3 * m + i] + (g->free_tool ? g->own[base + 3 * m + i] : 0.0);
      turned(c.R, marker, lever);
      for (int i = 0; i < 3; i++) away[i] = lever[i] + c.p[i];
      turned(turn, away, at);
      for (int i = 0; i < 3; i++) at[i] += place[i], away[i] = at[i] - g->centre[i];
      skew(lever, k);
      times(turn, k, by_turn);
      if (base) by_base(&of_base, away, point, turning);
      for (int i = 0; i < 3; i++) {
        const long row = 3 * m + i;
        const double angular[3] = {-by_turn[3 * i], -by_turn[3 * i + 1], -by_turn[3 * i + 2]};
        g->residual[row * N + s] = at[i] - g->seen[(s * g->markers + m) * 3 + i];
        respond(g, &c, s, row, rows, turn + 3 * i, angular);
        double *out = g->by_own + row * N + s;
        for (long n = 0; n < base; n++) out[n * next] = point[i][n];
        for (long n = base; n < own; n++) out[n * next] = (n - base) / 3 == m ? whole[3 * i + (n - base) % 3] : 0.0;
      }
    }
    if (!g->poses) continue;
    const double *back = g->back + 9 * s, *ways = g->body ? back : unturned;
    double R[9], angle[3], twist[9], axes[9], mine[9], linear[9], tilt[9], spin[9], by_tool[4][9];
    turned(c.R, arm, lever);
    for (int i = 0; i < 3; i++) away[i] = lever[i] + c.p[i];
    turned(turn, away, at);
    for (int i = 0; i < 3; i++) at[i] += place[i];
    times(back, whole, scratch);
    times(scratch, tool_turn, R);
    logarithm(R, angle);
    inverse_left_jacobian(angle, scratch);
    times(scratch, back, twist);
    times(twist, turn, spin);
    for (int i = 0; i < 3; i++) away[i] = at[i] - g->seen[3 * s + i];
    times(ways, turn, linear);
    skew(lever, k);
    times(linear, k, tilt);
    turned(ways, away, lever);
    for (int i = 0; i < 3; i++) g->residual[i * N + s] = lever[i], g->residual[(3 + i) * N + s] = angle[i], away[i] = at[i] - g->centre[i];
    for (int i = 0; i < 3; i++) {
      const double none[3] = {0.0, 0.0, 0.0}, angular[3] = {-tilt[3 * i], -tilt[3 * i + 1], -tilt[3 * i + 2]};
      respond(g, &c, s, i, rows, linear + 3 * i, angular);
      respond(g, &c, s, 3 + i, rows, none, spin + 3 * i);
    }
    if (base) {
      by_base(&of_base, away, point, turning);
      for (int i = 0; i < 3; i++)
        for (int n = 0; n < 6; n++) {
          double *out = g->by_own + n * next + s;
          out[i * N] = ways[3 * i] * point[0][n] + ways[3 * i + 1] * point[1][n] + ways[3 * i + 2] * point[2][n];
          out[(3 + i) * N] = twist[3 * i] * turning[0][n] + twist[3 * i + 1] * turning[1][n] + twist[3 * i + 2] * turning[2][n];
        }
    }
    if (g->free_tool) {
      times(whole, g->tool, axes);
      times(ways, axes, mine);
      times(mine, of_tool.bend, by_tool[0]);
      times(mine, tool_mixed, by_tool[1]);
      times(twist, axes, mine);
      times(mine, of_tool.bend, by_tool[3]);
      for (int i = 0; i < 3; i++)
        for (int n = 0; n < 3; n++) {
          double *out = g->by_own + (base + n) * next + s;
          out[i * N] = by_tool[0][3 * i + n], out[3 * next + i * N] = by_tool[1][3 * i + n];
          out[(3 + i) * N] = 0.0, out[3 * next + (3 + i) * N] = by_tool[3][3 * i + n];
        }
    }
    if (g->sight) { /* the device's origin as it is seen: rows and derivatives of the angles mixed into the positions */
      double eye[3];
      turned(back, g->seen + 3 * s, eye);
      skew(eye, k);
      mixed(g->residual + s, 1, next, N, k);
      mixed(g->response + s, 6 * g->joints, next, N, k);
      mixed(g->by_own + s, own, next, N, k);
    }
  }
}
