/* Rows of real series after a filter that is given by its response, of which every few numbers are wanted.

   A series goes apart into its `step` phases, each of `count` numbers. Two series with one response are the real and the
   imaginary part of one, and W such pairs lie side by side in a vector. The transform of a phase leaves its frequencies
   where its last stage put them, which is where the transform back begins: no number moves only to be in order. */
#include <stdlib.h>
#include <string.h>
#if defined(__AVX512F__)
#define W 8
#elif defined(__AVX__)
#define W 4
#else
#define W 2
#endif
typedef double V __attribute__((vector_size(8 * W)));
typedef struct {
  V re, im;
} C;
typedef struct {
  double re, im;
} P;

struct given {
  long count, step, samples, slots, rows, responses, used;
  const long *radix;     /* factors of count, 2 to 5, then 1 */
  const long *order;     /* (slots, step, count) sample at each place of each phase */
  const long *row;       /* (slots, rows) place of each row among the numbers wanted */
  const long *frequency; /* (count) at each place of a transform */
  const P *root;         /* (step * count) exp(-2 pi i k / (step * count)) */
  const P *turn;         /* (step, step * count) exp(-2 pi i m f / (step * count)), over step * count */
  const P *response;     /* (responses, step * count / 2 + 1) */
  const long *first;     /* (responses + 1) where the series of each response begin in `series` */
  const long *series;
  const long *slot;      /* (used) slots that are filtered */
  const double *signal;  /* (series, slots, samples) */
  double *out;           /* (series, slots, rows) */
};

#define FEW 128 /* places that are filled at once: they stay in the nearest cache */
#define NEAR 384 /* numbers of which none leaves the nearest cache while all their stages are taken */
#define INLINE static inline __attribute__((always_inline))

INLINE C plus(C a, C b) { return (C){a.re + b.re, a.im + b.im}; }
INLINE C less(C a, C b) { return (C){a.re - b.re, a.im - b.im}; }
INLINE C scaled(C a, double x) { return (C){a.re * x, a.im * x}; }
INLINE C turned(C a) { return (C){a.im, -a.re}; } /* by -i */
INLINE C times(C a, P w) { return (C){a.re * w.re - a.im * w.im, a.re * w.im + a.im * w.re}; }

/* The transform of r numbers. */
INLINE void small(C *a, const long r) {
  if (r == 2) {
    C d = less(a[0], a[1]);
    a[0] = plus(a[0], a[1]), a[1] = d;
  } else if (r == 3) {
    C s = plus(a[1], a[2]), d = turned(scaled(less(a[1], a[2]), 0.86602540378443864676)), m = less(a[0], scaled(s, 0.5));
    a[0] = plus(a[0], s), a[1] = plus(m, d), a[2] = less(m, d);
  } else if (r == 4) {
    C s = plus(a[0], a[2]), d = less(a[0], a[2]), t = plus(a[1], a[3]), e = turned(less(a[1], a[3]));
    a[0] = plus(s, t), a[1] = plus(d, e), a[2] = less(s, t), a[3] = less(d, e);
  } else {
    const double c1 = 0.30901699437494742410, c2 = -0.80901699437494742410;
    const double s1 = 0.95105651629515357212, s2 = 0.58778525229247312917;
    C s = plus(a[1], a[4]), t = plus(a[2], a[3]), d = turned(less(a[1], a[4])), e = turned(less(a[2], a[3]));
    C m = plus(a[0], plus(scaled(s, c1), scaled(t, c2))), n = plus(a[0], plus(scaled(s, c2), scaled(t, c1)));
    C u = plus(scaled(d, s1), scaled(e, s2)), v = less(scaled(d, s2), scaled(e, s1));
    a[0] = plus(a[0], plus(s, t)), a[1] = plus(m, u), a[4] = less(m, u), a[2] = plus(n, v), a[3] = less(n, v);
  }
}

/* One stage of all n numbers: of each r that stand q apart, turned before it on the way back, else behind it. */
INLINE void stage(C *x, long n, long q, const long r, const P *root, long by, int back) {
  for (C *block = x; block < x + n; block += q * r)
    for (long j = 0; j < q; j++) {
      C a[5];
      for (long i = 0; i < r; i++) a[i] = block[j + i * q];
      for (long i = 1; back && j && i < r; i++) a[i] = times(a[i], root[i * j * by]);
      small(a, r);
      for (long i = 1; !back && j && i < r; i++) a[i] = times(a[i], root[i * j * by]);
      for (long i = 0; i < r; i++) block[j + i * q] = a[i];
    }
}

INLINE void any_stage(C *x, long n, long q, long r, const P *root, long length, int back) {
  long by = length / (q * r);
  if (r == 2) stage(x, n, q, 2, root, by, back);
  else if (r == 3) stage(x, n, q, 3, root, by, back);
  else if (r == 4) stage(x, n, q, 4, root, by, back);
  else stage(x, n, q, 5, root, by, back);
}

/* The first stages part by part: what these leave fits into the nearest cache. */
static void forward(C *x, long n, const long *radix, const P *root, long length) {
  long q = n / *radix;
  if (n > NEAR) {
    any_stage(x, n, q, *radix, root, length, 0);
    for (long i = 0; i < *radix; i++) forward(x + i * q, q, radix + 1, root, length);
  } else
    for (long all = n; *radix > 1; n = q, radix++) q = n / *radix, any_stage(x, all, q, *radix, root, length, 0);
}

static void backward(C *x, long n, const long *radix, const P *root, long length) {
  long q = n / *radix;
  if (n > NEAR) {
    for (long i = 0; i < *radix; i++) backward(x + i * q, q, radix + 1, root, length);
    any_stage(x, n, q, *radix, root, length, 1);
  } else {
    const long *last = radix;
    while (*last > 1) last++;
    for (q = 1; last-- > radix; q *= *last) any_stage(x, n, q, *last, root, length, 1);
  }
}

/* What each frequency of a phase counts: the response where it is one of every `count`, turned by the phase's place. */
static void factors(const struct given *g, const P *response, P *full, P *out) {
  long count = g->count, length = count * g->step;
  for (long f = 0; f <= length / 2; f++) {
    full[f] = response[f];
    if (f) full[length - f] = (P){response[f].re, -response[f].im};
  }
  full[0].im = 0.0;
  if (length % 2 == 0) full[length / 2].im = 0.0;
  for (long m = 0; m < g->step; m++) {
    P *own = out + m * count;
    for (long k = 0; k <= count / 2; k++) own[k] = (P){0.0, 0.0};
    for (long l = 0; l < g->step; l++) {
      const P *h = full + l * count, *w = g->turn + m * length + l * count;
      for (long k = 0; k <= count / 2; k++) {
        own[k].re += h[k].re * w[k].re - h[k].im * w[k].im;
        own[k].im += h[k].re * w[k].im + h[k].im * w[k].re;
      }
    }
    for (long k = 1; k < (count + 1) / 2; k++) own[count - k] = (P){own[k].re, -own[k].im};
  }
}

int filtered(const struct given *g) {
  long count = g->count, step = g->step, length = count * step;
  C *x = aligned_alloc(64, length * sizeof(C));
  P *full = malloc(length * sizeof(P)), *factor = malloc(length * sizeof(P));
  if (x && full && factor) {
    for (long k = 0; k < g->responses; k++) {
      const long *series = g->series + g->first[k];
      long all = (g->first[k + 1] - g->first[k]) * g->used;
      if (all) factors(g, g->response + k * (length / 2 + 1), full, factor);
      for (long begin = 0; begin < all; begin += 2 * W) {
        long some = all - begin < 2 * W ? all - begin : 2 * W;
        if (some < 2 * W) memset(x, 0, length * sizeof(C)); /* what the others left would grow */
        for (long few = 0; few < length; few += FEW)
          for (long lane = 0; lane < some; lane++) {
            long one = series[(begin + lane) / g->used], slot = g->slot[(begin + lane) % g->used];
            const double *from = g->signal + (one * g->slots + slot) * g->samples;
            const long *order = g->order + slot * length;
            double *to = (double *)x + lane;
            for (long p = few; p < few + FEW && p < length; p++) to[2 * W * p] = from[order[p]];
          }
        for (long m = 0; m < step; m++) forward(x + m * count, count, g->radix, g->root, length);
        for (long j = 0; j < count; j++) {
          C sum = times(x[j], factor[g->frequency[j]]);
          for (long m = 1; m < step; m++) sum = plus(sum, times(x[m * count + j], factor[m * count + g->frequency[j]]));
          x[j] = (C){sum.im, sum.re}; /* with its parts exchanged, it is transformed back as another is forward */
        }
        backward(x, count, g->radix, g->root, length);
        for (long lane = 0; lane < some; lane++) {
          long one = series[(begin + lane) / g->used], slot = g->slot[(begin + lane) % g->used];
          const double *from = (double *)x + (lane + W) % (2 * W);
          double *to = g->out + (one * g->slots + slot) * g->rows;
          const long *row = g->row + slot * g->rows;
          for (long p = 0; p < g->rows; p++) to[p] = from[2 * W * row[p]];
        }
      }
    }
  }
  int done = x && full && factor;
  free(x), free(full), free(factor);
  return done;
}
