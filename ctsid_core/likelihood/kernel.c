// SPDX-License-Identifier: Apache-2.0
/*
 * One evaluation of the likelihood, compiled: twins of five functions of NumPy.
 *
 *     ctsid_columns  `mode_columns.py:columns_of`     records, poles, dead times -> triangles
 *     ctsid_solve    `output_error.py:_solved`        triangles -> all that is linear
 *     ctsid_errors   `output_error.py:errors_of`      columns -> measured less simulated outputs
 *     ctsid_jacobian `output_error.py:jacobian`       columns -> derivatives of the simulation
 *     ctsid_slopes   `output_error.py:_eliminated`    columns -> those by what is not linear
 *
 * Names and formulas are those of the twins, which explain them. A table is one stream's columns
 * beside its outputs, column after column (Fortran's order), turned to a triangle or not. Nothing
 * is kept between calls but the places of LAPACK's functions, and no call touches Python.
 * Complex numbers are pairs of doubles. What a function is given, and what it finds, is one array
 * each, for the caller pays for every array. Functions return 0, or 1 where memory is exhausted.
 */
#include <complex.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef double complex cplx;

/* Compiled for wide registers, too, if the loader can choose: the same bits, sooner. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

/* An input signal: `modal.py:Drive`, with the paces of a held one. */
typedef struct {
    const double *stamps, *pieces, *between, *rates;
    int count, width, degree;
} Drive;

typedef struct {
    const double *times, *y;            /* y: (count, channels) */
    int count, first, channels, record; /* first: place of the first channel */
} Stream;

typedef struct {
    double start;
    int drive, drives, stream, streams; /* places of the first ones, and how many there are */
} Record;

typedef struct {
    const Record *record;
    const Drive *drive;
    const Stream *stream;
    int records, streams, nu, ny;
} Samples;

/* What columns there are, in which order: see `mode_columns.py:_rows`. */
typedef struct {
    const int *group;           /* of each mode its pole: equal ones share their columns */
    int modes, single;          /* single: how many modes are real; these come first */
    int real, pairs, direct, slopes, trim;      /* real, pairs: how many poles of each kind */
} Shape;

/* A model, `modal_model.py:ModalModel`, and the mean squares of its errors, (records, ny). */
typedef struct {
    const double *poles, *delay;
    double *b, *c, *x0, *D, *y0, *power, *end;
} Model;

static Model model_of(const Samples *s, const Shape *shape, double *numbers) {
    size_t modes = shape->modes;
    Model m = {.poles = numbers, .b = numbers + 2 * modes};
    m.c = m.b + 2 * modes * s->nu;
    m.x0 = m.c + 2 * modes * s->ny;
    m.delay = m.x0 + 2 * modes * s->records;
    m.D = (double *)m.delay + s->nu;
    m.y0 = m.D + s->ny * s->nu;
    m.power = m.y0 + s->records * s->ny;
    m.end = m.power + s->records * s->ny;
    return m;
}

typedef void Tpqrt(int *, int *, int *, int *, double *, int *, double *, int *, double *, int *,
                   double *, int *);
typedef void Gelsy(int *, int *, int *, double *, int *, double *, int *, int *, double *, int *,
                   double *, int *, int *);
typedef void Geqp3(int *, int *, double *, int *, int *, double *, double *, int *, int *);
typedef void Ormqr(char *, char *, int *, int *, int *, double *, int *, double *, double *, int *,
                   double *, int *, int *);
static Tpqrt *tpqrt;
static Gelsy *gelsy;
static Geqp3 *geqp3;
static Ormqr *ormqr;

enum { PANEL = 4, BLOCK = 32, ROWS = 1024, DEGREES = 8, FEW = 32 };
static const double ROUNDING = 1e-24, RANK = 1e-13;

#ifndef EDITION         /* checksum of this file, from setup.py: Python asks whether it is still this */
#define EDITION 0u
#endif
unsigned ctsid_edition(void) { return EDITION; }

void ctsid_lapack(void *qr, void *least_squares, void *pivoting, void *turning) {
    tpqrt = (Tpqrt *)qr;
    gelsy = (Gelsy *)least_squares;
    geqp3 = (Geqp3 *)pivoting;
    ormqr = (Ormqr *)turning;
}

static int least(int a, int b) { return a < b ? a : b; }
static int most(int a, int b) { return a > b ? a : b; }

/* ---- responses of modes ------------------------------------------------------------------- */

static double over_factorial(int k) {
    static const double known[] = {
        1., 1., 1. / 2, 1. / 6, 1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880,
        1. / 3628800, 1. / 39916800, 1. / 479001600, 1. / 6227020800., 1. / 87178291200.,
        1. / 1307674368000., 1. / 20922789888000., 1. / 355687428096000., 1. / 6402373705728000.,
        1. / 121645100408832000., 1. / 2432902008176640000., 1. / 51090942171709440000.,
        1. / 1124000727777607680000., 1. / 25852016738884976640000., 1. / 6.2044840173323944e23,
        1. / 1.5511210043330986e25, 1. / 4.0329146112660565e26, 1. / 1.0888869450418352e28};
    return known[k];
}

/* Terms of the power series of phi_j at |x| < 1: more change nothing. */
static int terms_of(double size) {
    static const double below[] = {1e-3, 1e-2, 0.03, 0.1, 0.2, 0.4, 0.7};
    static const int terms[] = {5, 7, 8, 10, 11, 13, 15, 17};
    int k = 0;
    while (k < 7 && size >= below[k]) k++;
    return terms[k];
}

/*
 * phi_0 ... phi_count of p h for a few h, `matrix_functions.py:phi`: f[j][i], real parts before
 * imaginary ones. Sums over all h at once, for a processor has several under way.
 */
WIDE static void phis(cplx p, const double *h, int number, int count, double f[][2][FEW]) {
    double re[FEW], im[FEW], largest = 0.0, size = sqrt(creal(p) * creal(p) + cimag(p) * cimag(p));
    int real = cimag(p) == 0.0, small = 1;
    for (int i = 0; i < number; i++) largest = fabs(h[i]) > largest ? fabs(h[i]) : largest;
    small = size * largest < 1.0;
    for (int i = 0; i < number; i++) {
        int far = size * fabs(h[i]) >= 1.0;
        re[i] = far ? 0.0 : creal(p) * h[i];
        im[i] = far ? 0.0 : cimag(p) * h[i];
    }
    int terms = terms_of(small ? size * largest : 0.999);
    double(*top)[FEW] = f[count];
    for (int i = 0; i < number; i++) {
        top[0][i] = over_factorial(terms + count);
        top[1][i] = 0.0;
    }
    for (int k = terms - 1; k >= 0; k--) {
        double c = over_factorial(k + count);
        if (real)
            for (int i = 0; i < number; i++) top[0][i] = top[0][i] * re[i] + c;
        else
            for (int i = 0; i < number; i++) {
                double x = top[0][i] * re[i] - top[1][i] * im[i] + c;
                top[1][i] = top[0][i] * im[i] + top[1][i] * re[i];
                top[0][i] = x;
            }
    }
    for (int j = count - 1; j >= 0; j--) {
        double c = over_factorial(j);
        for (int i = 0; i < number; i++) {
            f[j][0][i] = f[j + 1][0][i] * re[i] - f[j + 1][1][i] * im[i] + c;
            f[j][1][i] = f[j + 1][0][i] * im[i] + f[j + 1][1][i] * re[i];
        }
    }
    for (int i = 0; i < number && !small; i++) {
        if (size * fabs(h[i]) < 1.0) continue;
        cplx x = p * h[i], value = real ? exp(creal(x)) : cexp(x);
        cplx inverse = conj(x) / (creal(x) * creal(x) + cimag(x) * cimag(x));
        for (int j = 0; j <= count; value = (value - over_factorial(j)) * inverse, j++) {
            f[j][0][i] = creal(value);
            f[j][1][i] = cimag(value);
        }
    }
}

/* What a mode does over a time h: the factors in (1) and (2) of `modal.py`, for any input. */
typedef struct {
    cplx keep, lag, push[DEGREES], turn[DEGREES];
} Step;

WIDE static void steps_of(cplx pole, const double *h, int number, int degree, int slopes, Step *to) {
    double f[DEGREES + 2][2][FEW];
    phis(pole, h, number, degree + 1 + slopes, f);
    for (int i = 0; i < number; i++) {
        double power = h[i];
        to[i].keep = f[0][0][i] + I * f[0][1][i];
        to[i].lag = h[i] * to[i].keep;
        for (int j = 0; j <= degree; j++, power *= h[i]) {
            cplx own = f[j + 1][0][i] + I * f[j + 1][1][i];
            to[i].push[j] = power * own;
            if (slopes)
                to[i].turn[j] = (power * h[i])
                    * (own - (j + 1) * (f[j + 2][0][i] + I * f[j + 2][1][i]));
        }
    }
}

/* A mode after a step, and its derivative by the pole. u: derivatives of the input, so far apart. */
static inline void take(const Step *by, int degree, const double *u, size_t apart, int slopes,
                        cplx z, cplx s, cplx *later, cplx *bent) {
    cplx push = by->push[0] * u[0];
    for (int j = 1; j <= degree; j++) push += by->push[j] * u[j * apart];
    *later = by->keep * z + push;
    if (!slopes) return;
    cplx turn = by->turn[0] * u[0];
    for (int j = 1; j <= degree; j++) turn += by->turn[j] * u[j * apart];
    *bent = by->keep * s + by->lag * z + turn;
}

/* How many stamps are not later than t. */
static int place_of(const double *stamps, int count, double t) {
    int low = 0;
    while (low < count) {
        int middle = low + (count - low) / 2;
        if (stamps[middle] <= t) low = middle + 1; else count = middle;
    }
    return low;
}

/* The derivatives of the polynomial before stamp `place`, at a time. */
static void polynomial(const Drive *d, int channel, int place, double at, double *u) {
    double raw[DEGREES];
    for (int j = 0; j <= d->degree; j++)
        raw[j] = d->pieces[((size_t)j * d->width + channel) * (d->count + 1) + place];
    double h = place && d->degree ? at - d->stamps[place - 1] : 0.0;
    for (int j = 0; j <= d->degree; j++) {
        double power = 1.0;
        u[j] = 0.0;
        for (int k = j; k <= d->degree; k++, power *= h)
            u[j] += raw[k] * power * over_factorial(k - j);
    }
}

/* One input of one record: where its responses begin, and the modes at its stamps. */
typedef struct {
    const Drive *drive;
    int channel, first, end;        /* stamps first .. end - 1 are passed */
    double start, delay, begin, u[DEGREES];
    cplx *z, *s, *free;             /* (modes, end - first); s: derivatives, if they are wanted;
                                       free: responses to initial states, kept by one input */
} Entry;

/* Where the state of a mode at a stamp is kept. */
static inline size_t kept(const Entry *e, int mode, int stamp) {
    return (size_t)mode * (e->end - e->first) + (stamp - e->first);
}

WIDE static void pass_stamps(Entry *group, int inputs, const cplx *poles, int modes, int slopes) {
    const Drive *d = group->drive;
    int low = d->count, high = 0, degree = d->degree;
    size_t apart = (size_t)d->width * (d->count + 1);
    double h[FEW];
    Step by[FEW], own;
    for (int c = 0; c < inputs; c++) {
        low = least(low, group[c].first);
        high = most(high, group[c].end);
    }
    for (int l = 0; l < modes; l++)
        for (int from = low; from < high; from += FEW) {
            int number = least(FEW, high - from);
            for (int i = 0; i < number; i++)
                h[i] = from + i > low ? d->stamps[from + i] - d->stamps[from + i - 1] : 0.0;
            steps_of(poles[l], h, number, degree, slopes, by);
            for (int c = 0; c < inputs; c++) {
                Entry *e = group + c;
                int k = most(from, e->first), end = least(from + number, e->end);
                const double *u = d->pieces + (size_t)e->channel * (d->count + 1);
                cplx z = 0.0, bent = 0.0, free = 1.0;
                if (k < end && e->free) {       /* from here in steps: an exponential takes long */
                    cplx x = poles[l] * (d->stamps[k] - e->begin);
                    free = cimag(x) == 0.0 ? exp(creal(x)) : cexp(x);
                }
                if (k < end && k == e->first) {
                    double since = d->stamps[k] - e->begin;
                    steps_of(poles[l], &since, 1, degree, slopes, &own);
                    take(&own, degree, e->u, 1, slopes, z, bent, &z, &bent);
                } else if (k < end) {
                    size_t before = kept(e, l, k - 1);
                    take(by + k - from, degree, u + k, apart, slopes, e->z[before],
                         slopes ? e->s[before] : 0.0, &z, &bent);
                }
                for (size_t at = kept(e, l, k); k < end; at++) {
                    e->z[at] = z;
                    if (slopes) e->s[at] = bent;
                    if (e->free) e->free[at] = free;
                    if (++k == end) break;
                    take(by + k - from, degree, u + k, apart, slopes, z, bent, &z, &bent);
                    free *= by[k - from].keep;
                }
            }
        }
}

static int wide_of(const Samples *s) { return s->nu + 1; }

static int of_modes(const Samples *s, const Shape *shape) {
    return wide_of(s) * (shape->real + 2 * shape->pairs) * (1 + shape->slopes);
}

/* How many columns there are, the outputs apart. */
static int width_of(const Samples *s, const Shape *shape) {
    return of_modes(s, shape) + s->nu * (shape->direct + shape->slopes) + 1;
}

/* The column of a mode's response to an input, or to its initial state (input nu). */
static int place_in(const Samples *s, const Shape *shape, int slope, int imag, int mode,
                    int input) {
    int wide = wide_of(s);
    if (mode < shape->real) return (slope * shape->real + mode) * wide + input;
    return wide * (shape->real * (1 + shape->slopes)
                   + (2 * slope + imag) * shape->pairs + mode - shape->real) + input;
}

/* Where some times of a stream lie among the stamps of an input, and how long after them. */
typedef struct {
    int place[FEW], start[FEW];
    double h[FEW], wanted[FEW];
} Spots;

static void spots_of(const Entry *e, const double *times, int number, Spots *to) {
    const Drive *d = e->drive;
    int pos = 0;
    for (int i = 0; i < number; i++) {
        double wanted = to->wanted[i] = times[i] - e->delay;
        if (i == 0) pos = place_of(d->stamps, d->count, wanted);
        while (pos < d->count && d->stamps[pos] <= wanted) pos++;
        to->place[i] = pos;
        to->start[i] = pos <= e->first;
        to->h[i] = wanted - (to->start[i] ? e->begin : d->stamps[pos - 1]);
    }
}

/* The input itself, and its derivative: of a held one that of `modal.py:Drive.paces`. */
static double input_at(const Entry *e, const Spots *spots, int i, double *rate) {
    const Drive *d = e->drive;
    int pos = spots->place[i], degree = d->degree;
    size_t apart = spots->start[i] ? 1 : (size_t)d->width * (d->count + 1);
    const double *u = spots->start[i] ? e->u
        : d->pieces + (size_t)e->channel * (d->count + 1) + pos;
    double value = 0.0, power = 1.0;
    *rate = 0.0;
    for (int j = 0; j <= degree; j++, power *= spots->h[i]) {
        value += u[j * apart] * power * over_factorial(j);
        if (j < degree) *rate += u[(j + 1) * apart] * power * over_factorial(j);
    }
    if (degree == 0 && d->count) {
        int between = least(pos, d->count - 1);         /* or one less */
        while (between > 0 && d->between[between - 1] >= spots->wanted[i]) between--;
        *rate = d->rates[(size_t)e->channel * d->count + between];
    }
    return value;
}

/* Read inputs of the same delay at a few times of a stream, and write their columns. */
WIDE static void read_inputs(const Samples *s, const Shape *shape, const Entry *group, int inputs,
                        int input, const cplx *poles, const double *times, int number,
                        double *table, int ld) {
    const Drive *d = group->drive;
    int modes = shape->real + shape->pairs, degree = d->degree, slopes = shape->slopes;
    size_t apart = (size_t)d->width * (d->count + 1);
    Spots spots;
    Step by[FEW];
    cplx z, bent = 0.0;
    spots_of(group, times, number, &spots);
    for (int l = 0; l < modes; l++) {
        steps_of(poles[l], spots.h, number, degree, slopes, by);
        for (int c = 0; c < inputs; c++) {
            const Entry *e = group + c;
            double *parts[2][2] = {{0}};
            for (int slope = 0; slope < 1 + slopes; slope++)
                for (int imag = 0; imag < 1 + (l >= shape->real); imag++)
                    parts[slope][imag] = table
                        + (size_t)place_in(s, shape, slope, imag, l, input + c) * ld;
            for (int i = 0; i < number; i++) {
                if (spots.start[i])
                    take(by + i, degree, e->u, 1, slopes, 0.0, 0.0, &z, &bent);
                else {
                    size_t at = kept(e, l, spots.place[i] - 1);
                    take(by + i, degree,
                         d->pieces + (size_t)e->channel * (d->count + 1) + spots.place[i], apart,
                         slopes, e->z[at], slopes ? e->s[at] : 0.0, &z, &bent);
                }
                parts[0][0][i] = creal(z);
                if (l >= shape->real) parts[0][1][i] = cimag(z);
                if (!slopes) continue;
                parts[1][0][i] = creal(bent);
                if (l >= shape->real) parts[1][1][i] = cimag(bent);
            }
            for (int i = 0; i < number && e->free; i++) {
                cplx free = by[i].keep;
                if (!spots.start[i]) free *= e->free[kept(e, l, spots.place[i] - 1)];
                for (int imag = 0; imag < 1 + (l >= shape->real); imag++) {
                    double value = imag ? cimag(free) : creal(free);
                    table[(size_t)place_in(s, shape, 0, imag, l, s->nu) * ld + i] = value;
                    if (slopes)
                        table[(size_t)place_in(s, shape, 1, imag, l, s->nu) * ld + i] =
                            (times[i] - e->start) * value;
                }
            }
        }
    }
    for (int c = 0; c < inputs && (shape->direct || slopes); c++)
        for (int i = 0; i < number; i++) {
            double rate, *column = table + (size_t)(of_modes(s, shape) + input + c) * ld + i;
            *column = input_at(group + c, &spots, i, &rate);
            if (shape->direct && slopes) column[(size_t)s->nu * ld] = rate;
        }
}

/* Write the columns of some samples of a stream, outputs beside. */
WIDE static void fill(const Samples *s, const Shape *shape, const Entry *entries, const cplx *poles,
                      const Stream *stream, int from, int count, double *table, int ld) {
    const double *times = stream->times + from;
    int width = width_of(s, shape);
    for (int j = 0; j < s->nu;) {
        int same = 1;
        while (j + same < s->nu && entries[j + same].drive == entries[j].drive
               && entries[j + same].delay == entries[j].delay) same++;
        for (int i = 0; i < count; i += FEW)
            read_inputs(s, shape, entries + j, same, j, poles, times + i, least(FEW, count - i),
                        table + i, ld);
        j += same;
    }
    for (int i = 0; i < count; i++) table[(size_t)(width - 1) * ld + i] = 1.0;
    for (int k = 0; k < stream->channels; k++)
        for (int i = 0; i < count; i++)
            table[(size_t)(width + k) * ld + i] =
                stream->y[(size_t)(from + i) * stream->channels + k];
}

/* The triangle of a stream's columns: blocks of rows, that stay in the cache, one after another. */
static int turned(const Samples *s, const Shape *shape, const Entry *entries, const cplx *poles,
                  const Stream *stream, double *table) {
    int columns = width_of(s, shape) + stream->channels, ld = least(ROWS, stream->count), info;
    int none = 0, panel = least(PANEL, columns);
    double *block = malloc(sizeof(double) * (size_t)columns * (ld + 2 * PANEL));
    if (!block) return 1;
    double *factors = block + (size_t)ld * columns, *work = factors + (size_t)PANEL * columns;
    memset(table, 0, sizeof(double) * columns * columns);
    for (int from = 0; from < stream->count; from += ROWS) {
        int count = least(ROWS, stream->count - from);
        fill(s, shape, entries, poles, stream, from, count, block, ld);
        tpqrt(&count, &columns, &none, &panel, table, &columns, block, &ld, factors, &panel, work,
              &info);
    }
    free(block);
    return 0;
}

/*
 * given: poles and dead times. rows: of each stream; as many as there are samples where it is not
 * turned. tables: on return with the inputs at the start of each record, (records, nu), behind.
 */
int ctsid_columns(const Samples *s, const Shape *shape, const double *given, const int *rows,
                  double *tables) {
    int modes = shape->real + shape->pairs, failed = 0;
    const cplx *p = (const cplx *)given;
    const double *delay = given + 2 * modes;
    double *first = tables;
    for (int k = 0; k < s->streams; k++)
        first += (size_t)rows[k] * (width_of(s, shape) + s->stream[k].channels);
    for (int r = 0; r < s->records && !failed; r++) {
        const Record *record = s->record + r;
        double last = record->start;
        size_t room = 0;
        for (int k = 0; k < record->streams; k++) {
            const Stream *stream = s->stream + record->stream + k;
            for (int i = 0; i < stream->count; i++)
                if (stream->times[i] > last) last = stream->times[i];
        }
        Entry *entries = malloc(sizeof(Entry) * (s->nu + 1));
        if (!entries) return 1;
        for (int k = 0, j = 0; k < record->drives; k++) {
            const Drive *d = s->drive + record->drive + k;
            for (int c = 0; c < d->width; c++, j++) {
                Entry *e = entries + j;
                *e = (Entry){.drive = d, .channel = c, .start = record->start, .delay = delay[j],
                             .begin = record->start - delay[j]};
                e->first = place_of(d->stamps, d->count, e->begin);
                e->end = most(place_of(d->stamps, d->count, last - delay[j]), e->first);
                polynomial(d, c, e->first, e->begin, e->u);
                first[r * s->nu + j] = e->u[0];
                room += (size_t)modes * (e->end - e->first) * (1 + shape->slopes + !j);
            }
        }
        cplx *states = malloc(sizeof(cplx) * (room + 1)), *at = states;
        if (!states) {
            free(entries);
            return 1;
        }
        for (int j = 0; j < s->nu; j++) {
            Entry *e = entries + j;
            size_t size = (size_t)modes * (e->end - e->first);
            e->z = at;
            e->s = at + size * shape->slopes;       /* never written without slopes */
            at += size * (1 + shape->slopes);
            if (!j) {
                e->free = at;
                at += size;
            }
        }
        for (int j = 0; j < s->nu; j += entries[j].drive->width)
            pass_stamps(entries + j, entries[j].drive->width, p, modes, shape->slopes);
        for (int k = 0; k < record->streams && !failed; k++, rows++) {
            const Stream *stream = s->stream + record->stream + k;
            int columns = width_of(s, shape) + stream->channels;
            if (*rows < stream->count)
                failed = turned(s, shape, entries, p, stream, tables);
            else
                fill(s, shape, entries, p, stream, 0, stream->count, tables,
                     most(stream->count, 1));
            tables += (size_t)*rows * columns;
        }
        free(entries);
        free(states);
    }
    return failed;
}

/* ---- what is linear ----------------------------------------------------------------------- */

typedef struct {
    const Samples *s;
    const Shape *shape;
    const double *table;
    const Stream *stream;
    int rows, filled;       /* filled: of a triangle the rows of a column end at its place */
} Table;

static double *column(const Table *t, int place) {
    return (double *)t->table + (size_t)place * t->rows;
}

/* Add a multiple of a column. */
static inline void add(const Table *t, int place, double weight, double *to) {
    const double *from = column(t, place);
    int count = t->filled ? t->rows : least(t->rows, place + 1);
    for (int i = 0; i < count; i++) to[i] += weight * from[i];
}

/* Add the real part (imag: less the imaginary part) of a multiple of a mode's response. */
static void add_response(const Table *t, int slope, int mode, int input, cplx weight, int imag,
                         double *to) {
    int pair = mode >= t->shape->single, pole = t->shape->group[mode];
    double re = creal(weight), im = cimag(weight);
    add(t, place_in(t->s, t->shape, slope, 0, pole, input), imag ? -im : re, to);
    if (pair) add(t, place_in(t->s, t->shape, slope, 1, pole, input), imag ? -re : -im, to);
}

/* Add what all that drives a mode makes of it, times a weight. */
static void add_driven(const Table *t, const Model *m, int slope, int mode, cplx weight, int imag,
                       double *to) {
    int nu = t->s->nu, modes = t->shape->modes;
    for (int j = 0; j < nu; j++)
        add_response(t, slope, mode, j, weight * ((cplx *)m->b)[mode * nu + j], imag, to);
    add_response(t, slope, mode, nu,
                 weight * ((cplx *)m->x0)[t->stream->record * modes + mode], imag, to);
}

static int input_place(const Table *t) { return of_modes(t->s, t->shape); }
static int one_place(const Table *t) { return width_of(t->s, t->shape) - 1; }

/* Errors of an output: measured less simulated. */
static void error_of(const Table *t, const Model *m, int k, double *error) {
    int nu = t->s->nu, ny = t->s->ny, modes = t->shape->modes;
    int i = t->stream->first + k;
    memset(error, 0, sizeof(double) * t->rows);
    for (int l = 0; l < modes; l++) add_driven(t, m, 0, l, -((cplx *)m->c)[i * modes + l], 0, error);
    for (int j = 0; j < nu && (t->shape->direct || t->shape->slopes); j++)
        add(t, input_place(t) + j, -m->D[i * nu + j], error);
    add(t, one_place(t), -m->y0[t->stream->record * ny + i], error);
    add(t, one_place(t) + 1 + k, 1.0, error);
}

/* Coefficients of columns, of least norm in units of these: `least_squares.py:least_norm`. */
static int least_squares(double *matrix, int rows, int columns, double *target, double *theta,
                         int ld) {
    int rank, info, one = 1, room = 4 * columns + 1 + BLOCK * (columns + 1);
    if (rows < 1) {
        memset(theta, 0, sizeof(double) * columns);
        return 0;
    }
    double rcond = RANK, *scale = malloc(sizeof(double) * (columns + room));
    int *pivots = calloc(columns + 1, sizeof(int));
    if (!scale || !pivots) {
        free(scale);
        free(pivots);
        return 1;
    }
    for (int q = 0; q < columns; q++) {
        double sum = 0.0, *own = matrix + (size_t)q * ld;
        for (int i = 0; i < rows; i++) sum += own[i] * own[i];
        scale[q] = sum > 0.0 ? sqrt(sum) : 1.0;
        for (int i = 0; i < rows; i++) own[i] /= scale[q];
    }
    gelsy(&rows, &columns, &one, matrix, &ld, target, &ld, pivots, &rcond, &rank,
          scale + columns, &room, &info);
    for (int q = 0; q < columns; q++) theta[q] = target[q] / scale[q];
    free(scale);
    free(pivots);
    return 0;
}

static int states_of(const Shape *shape) { return 2 * shape->modes - shape->single; }

/* Complex coefficients of modes from real ones, all real parts before imaginary. */
static cplx coefficient(const Shape *shape, const double *theta, int stride, int mode) {
    int modes = shape->modes, pair = mode - shape->single;
    return theta[mode * stride] + (pair < 0 ? 0.0 : I * theta[(modes + pair) * stride]);
}

static int solve_c(const Table *tables, Model *m, const double *power) {
    const Samples *s = tables->s;
    const Shape *shape = tables->shape;
    int modes = shape->modes, n = states_of(shape), nd = s->nu * shape->direct;
    int columns = n + nd + s->records * shape->trim, rows = 0;
    for (int k = 0; k < s->streams; k++) rows += tables[k].rows;
    int ld = most(most(rows, columns), 1);
    double *matrix = malloc(sizeof(double) * ((size_t)ld * (2 * columns + 1) + columns));
    if (!matrix) return 1;
    double *own = matrix + (size_t)ld * columns, *target = own + (size_t)ld * columns;
    double *theta = target + ld;
    memset(matrix, 0, sizeof(double) * (size_t)ld * columns);
    for (int k = 0, at = 0; k < s->streams; at += tables[k++].rows) {
        const Table *t = tables + k;
        for (int l = 0; l < modes; l++) {
            add_driven(t, m, 0, l, 1.0, 0, matrix + (size_t)l * ld + at);
            if (l >= shape->single)
                add_driven(t, m, 0, l, 1.0, 1, matrix + (size_t)(modes + l - shape->single) * ld + at);
        }
        for (int j = 0; j < nd; j++)
            add(t, input_place(t) + j, 1.0, matrix + (size_t)(n + j) * ld + at);
        if (shape->trim)
            add(t, one_place(t), 1.0, matrix + (size_t)(n + nd + t->stream->record) * ld + at);
    }
    cplx *c = malloc(sizeof(cplx) * s->ny * (modes + 1));
    int failed = !c;
    for (int i = 0; i < s->ny && !failed; i++) {
        int used = 0;
        for (int k = 0, at = 0; k < s->streams; at += tables[k++].rows) {
            const Table *t = tables + k;
            int channel = i - t->stream->first;
            if (channel < 0 || channel >= t->stream->channels) continue;
            double weight = 1.0 / sqrt(fmax(power[t->stream->record * s->ny + i], ROUNDING));
            for (int q = 0; q < columns; q++)
                for (int row = 0; row < t->rows; row++)
                    own[(size_t)q * ld + used + row] = weight * matrix[(size_t)q * ld + at + row];
            memset(target + used, 0, sizeof(double) * t->rows);
            add(t, one_place(t) + 1 + channel, weight, target + used);
            used += t->rows;
        }
        failed = least_squares(own, used, columns, target, theta, ld);
        for (int l = 0; l < modes; l++) c[i * modes + l] = coefficient(shape, theta, 1, l);
        for (int j = 0; j < nd; j++) m->D[i * s->nu + j] = theta[n + j];
        for (int r = 0; r < s->records * shape->trim; r++) m->y0[r * s->ny + i] = theta[n + nd + r];
    }
    if (!failed) memcpy(m->c, c, sizeof(cplx) * s->ny * modes);
    free(c);
    free(matrix);
    return failed;
}

static int solve_b(const Table *tables, Model *m, const double *power) {
    const Samples *s = tables->s;
    const Shape *shape = tables->shape;
    int modes = shape->modes, n = states_of(shape), nu = s->nu, ny = s->ny;
    int nd = nu * shape->direct, own = nd + s->records * shape->trim;
    int driven = n * (nu + s->records), columns = driven + ny * own, rows = 0;
    for (int k = 0; k < s->streams; k++) rows += tables[k].rows * tables[k].stream->channels;
    int ld = most(most(rows, columns), 1);
    double *matrix = calloc((size_t)ld * (columns + 1) + columns, sizeof(double));
    if (!matrix) return 1;
    double *target = matrix + (size_t)ld * columns, *theta = target + ld;
    for (int k = 0, at = 0; k < s->streams; k++) {
        const Table *t = tables + k;
        int r = t->stream->record;
        for (int q = 0; q < t->stream->channels; q++, at += t->rows) {
            int i = t->stream->first + q;
            double weight = 1.0 / sqrt(fmax(power[r * ny + i], ROUNDING)), *to = matrix + at;
            for (int l = 0; l < modes; l++) {
                cplx c = weight * ((cplx *)m->c)[i * modes + l];
                for (int imag = 0; imag < 1 + (l >= shape->single); imag++) {
                    int row = imag ? modes + l - shape->single : l;
                    for (int j = 0; j < nu; j++)
                        add_response(t, 0, l, j, c, imag, to + (size_t)(row * nu + j) * ld);
                    add_response(t, 0, l, nu, c, imag, to + (size_t)(n * (nu + r) + row) * ld);
                }
            }
            for (int j = 0; j < nd; j++)
                add(t, input_place(t) + j, weight, to + (size_t)(driven + i * own + j) * ld);
            if (shape->trim)
                add(t, one_place(t), weight, to + (size_t)(driven + i * own + nd + r) * ld);
            add(t, one_place(t) + 1 + q, weight, target + at);
        }
    }
    int failed = least_squares(matrix, rows, columns, target, theta, ld);
    for (int l = 0; l < modes; l++) {
        for (int j = 0; j < nu; j++)
            ((cplx *)m->b)[l * nu + j] = coefficient(shape, theta + j, nu, l);
        for (int r = 0; r < s->records; r++)
            ((cplx *)m->x0)[r * modes + l] = coefficient(shape, theta + n * (nu + r), 1, l);
    }
    for (int i = 0; i < ny; i++) {
        for (int j = 0; j < nu; j++) m->D[i * nu + j] = nd ? theta[driven + i * own + j] : 0.0;
        for (int r = 0; r < s->records; r++)
            m->y0[r * ny + i] = shape->trim ? theta[driven + i * own + nd + r] : 0.0;
    }
    free(matrix);
    return failed;
}

static int powers(const Table *tables, const Model *m, double *power) {
    const Samples *s = tables->s;
    int longest = 1;
    for (int k = 0; k < s->streams; k++) longest = most(longest, tables[k].rows);
    double *error = malloc(sizeof(double) * longest);
    if (!error) return 1;
    for (int q = 0; q < s->records * s->ny; q++) power[q] = 1.0;
    for (int k = 0; k < s->streams; k++) {
        const Table *t = tables + k;
        for (int q = 0; q < t->stream->channels; q++) {
            double sum = 0.0;
            error_of(t, m, q, error);
            for (int row = 0; row < t->rows; row++) sum += error[row] * error[row];
            power[t->stream->record * s->ny + t->stream->first + q] =
                sum / most(t->stream->count, 1) + 1e-300;
        }
    }
    free(error);
    return 0;
}

/* b of size 1 (c of size 1 for one output). */
static void normalise(const Samples *s, const Shape *shape, Model *m) {
    int modes = shape->modes, nu = s->nu;
    cplx *b = (cplx *)m->b, *c = (cplx *)m->c, *x0 = (cplx *)m->x0;
    for (int l = 0; l < modes && s->ny > 1; l++) {
        double size = 0.0;
        for (int j = 0; j < nu; j++) size += creal(b[l * nu + j] * conj(b[l * nu + j]));
        size = size > 0.0 ? sqrt(size) : 1.0;
        for (int j = 0; j < nu; j++) b[l * nu + j] /= size;
        for (int r = 0; r < s->records; r++) x0[r * modes + l] /= size;
        for (int i = 0; i < s->ny; i++) c[i * modes + l] *= size;
    }
}

static void tables_of(const Samples *s, const Shape *shape, const int *rows,
                      const double *values, Table *tables) {
    for (int k = 0; k < s->streams; k++) {
        const Stream *stream = s->stream + k;
        tables[k] = (Table){s, shape, values, stream, rows[k], rows[k] == stream->count};
        values += (size_t)rows[k] * (width_of(s, shape) + stream->channels);
    }
}

/* numbers: the model given and the power of its errors, and on return those of the best one. */
int ctsid_solve(const Samples *s, const Shape *shape, const int *rows, const double *values,
                double *numbers) {
    Model own = model_of(s, shape, numbers), *m = &own;
    double *power = own.power;
    int size = s->records * s->ny, failed;
    Table *tables = malloc(sizeof(Table) * (s->streams + 1));
    double *old = malloc(sizeof(double) * (size + 1));
    failed = !tables || !old;
    if (!failed) tables_of(s, shape, rows, values, tables);
    for (int pass = 0; pass < 2 && !failed; pass++) {
        if (s->ny > 1) failed = solve_c(tables, m, power);
        failed = failed || solve_b(tables, m, power);
        memcpy(old, power, sizeof(double) * size);
        failed = failed || powers(tables, m, power);
        int settled = 1;
        for (int q = 0; q < size; q++) settled &= fabs(log(power[q] / old[q])) < 0.1;
        if (size == 1 || settled) break;
    }
    normalise(s, shape, m);
    free(tables);
    free(old);
    return failed;
}

/* errors: of each output of each stream, one after another. */
int ctsid_errors(const Samples *s, const Shape *shape, const int *rows, const double *values,
                 double *numbers, double *errors) {
    Model m = model_of(s, shape, numbers);
    Table *tables = malloc(sizeof(Table) * (s->streams + 1));
    if (!tables) return 1;
    tables_of(s, shape, rows, values, tables);
    for (int k = 0; k < s->streams; k++)
        for (int q = 0; q < tables[k].stream->channels; q++, errors += tables[k].rows)
            error_of(tables + k, &m, q, errors);
    free(tables);
    return 0;
}

/* ---- derivatives ---------------------------------------------------------------------------- */

/* Numbers that a model is derived by: coordinates of its poles, dead times, and the rest. */
typedef struct {
    const double *first, *dp, *late;    /* first: the inputs at the start */
    int coordinates, delays;
} Moves;

/* Where the derivatives of one output of one stream go, column after column; NULL: nowhere. */
typedef struct {
    double *poles, *delays, *b, *x0, *c, *D, *y0, *error;
} Places;

/* All over the noise, added. */
static void derivatives(const Table *t, const Model *m, const Moves *by, int channel, size_t ld,
                        const Places *to) {
    const Samples *s = t->s;
    const Shape *shape = t->shape;
    int r = t->stream->record, i = t->stream->first + channel, nu = s->nu, modes = shape->modes;
    const cplx *p = (const cplx *)m->poles, *b = (cplx *)m->b, *turn = (const cplx *)by->dp;
    const cplx *c = (cplx *)m->c + i * modes;
    double weight = 1.0 / sqrt(fmax(m->power[r * s->ny + i], ROUNDING)), *J = to->poles;
    for (int q = 0; q < by->coordinates; q++, J += ld)
        for (int l = 0; l < modes; l++)
            if (turn[q * modes + l] != 0.0)
                add_driven(t, m, 1, l, weight * c[l] * turn[q * modes + l], 0, J);
    J = to->delays;
    for (int q = 0; q < by->delays; q++, J += ld) {
        int j = (int)by->late[q];
        cplx direct = 0.0;
        for (int l = 0; l < modes; l++) {
            cplx moved = weight * c[l] * b[l * nu + j];
            direct += moved;
            add_response(t, 0, l, nu, moved * by->first[r * nu + j], 0, J);
            add_response(t, 0, l, j, -moved * p[l], 0, J);
        }
        add(t, input_place(t) + j, -creal(direct), J);
        if (shape->direct) add(t, input_place(t) + nu + j, -weight * m->D[i * nu + j], J);
    }
    for (int imag = 0, row = 0; imag < 2; imag++)
        for (int l = imag ? shape->single : 0; l < modes; l++, row++) {
            for (int j = 0; j < nu; j++)
                add_response(t, 0, l, j, weight * c[l], imag, to->b + (row * nu + j) * ld);
            add_response(t, 0, l, nu, weight * c[l], imag,
                         to->x0 + ((size_t)r * states_of(shape) + row) * ld);
            if (to->c) add_driven(t, m, 0, l, weight, imag, to->c + row * ld);
        }
    for (int j = 0; j < nu * shape->direct; j++)
        add(t, input_place(t) + j, weight, to->D + j * ld);
    if (shape->trim) add(t, one_place(t), weight, to->y0 + (size_t)r * ld);
    error_of(t, m, channel, to->error);
    for (int row = 0; row < t->rows; row++) to->error[row] *= weight;
}

/*
 * numbers: a model with the power of its errors, then the derivatives of modes by the coordinates
 * of the poles, (coordinates, modes), then the inputs whose dead times are free. first: the inputs
 * at the start. found: the derivatives over the noise, (height, columns), then the errors over it,
 * of each output of each stream in turn; zero on entry.
 */
int ctsid_jacobian(const Samples *s, const Shape *shape, const int *rows, const double *values,
                   const double *first, double *numbers, int coordinates, int delays, int height,
                   double *found) {
    Model m = model_of(s, shape, numbers);
    Moves by = {first, m.end, m.end + 2 * (size_t)coordinates * shape->modes, coordinates, delays};
    int n = states_of(shape), own = n + s->nu * shape->direct + s->records * shape->trim;
    size_t ld = height;
    Table *tables = malloc(sizeof(Table) * (s->streams + 1));
    if (!tables) return 1;
    tables_of(s, shape, rows, values, tables);
    for (int k = 0; k < s->streams; k++)
        for (int q = 0; q < tables[k].stream->channels; q++, found += tables[k].rows) {
            Places to = {.poles = found};
            to.delays = to.poles + coordinates * ld;
            to.b = to.delays + delays * ld;
            to.x0 = to.b + (size_t)n * s->nu * ld;
            to.c = to.x0 + (size_t)n * s->records * ld;
            to.error = to.c + (size_t)own * s->ny * ld;
            to.c += (size_t)own * (tables[k].stream->first + q) * ld;
            to.D = to.c + n * ld;
            to.y0 = to.D + (size_t)s->nu * shape->direct * ld;
            derivatives(tables + k, &m, &by, q, ld, &to);
        }
    free(tables);
    return 0;
}

/* In a fixed order, for else sums would depend on the processor. */
WIDE static double product(const double *a, const double *b, int count) {
    double sums[4] = {0.0};
    int i = 0;
    for (; i + 4 <= count; i += 4)
        for (int k = 0; k < 4; k++) sums[k] += a[i + k] * b[i + k];
    for (; i < count; i++) sums[0] += a[i] * b[i];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

/*
 * found: of poles, dead times and, of several outputs, b and initial states the curvature, (n, n),
 * and the gradient of half of -2 log likelihood, all that is linear else eliminated, and the
 * squares of the derivatives; then the squares that what is linear alone explains. Arguments: see
 * above.
 */
int ctsid_slopes(const Samples *s, const Shape *shape, const int *rows, const double *values,
                 const double *first, double *numbers, int coordinates, int delays,
                 double *found) {
    Model m = model_of(s, shape, numbers);
    Moves by = {first, m.end, m.end + 2 * (size_t)coordinates * shape->modes, coordinates, delays};
    int states = states_of(shape), several = s->ny > 1, nd = s->nu * shape->direct;
    int shared = states * (s->nu + s->records), moving = coordinates + delays + several * shared;
    int own = (several ? states : shared) + nd + s->records * shape->trim, ld = 1, info;
    int room = BLOCK * (own + moving + 2);
    for (int k = 0; k < s->streams; k++) ld += rows[k];
    Table *tables = malloc(sizeof(Table) * (s->streams + 1));
    double *slopes = malloc(sizeof(double) * ((size_t)ld * (moving + 1 + own) + own + room));
    int *pivots = malloc(sizeof(int) * (own + 1));
    double *gradient = found + (size_t)moving * moving, *squares = gradient + moving;
    if (!tables || !slopes || !pivots) {
        free(tables);
        free(slopes);
        free(pivots);
        return 1;
    }
    double *linear = slopes + (size_t)ld * (moving + 1), *tau = linear + (size_t)ld * own;
    tables_of(s, shape, rows, values, tables);
    for (int i = 0; i < s->ny; i++) {
        int used = 0, rank = 0, all = moving + 1;
        memset(slopes, 0, sizeof(double) * ld * (moving + 1 + own));
        for (int k = 0; k < s->streams; k++) {
            int channel = i - tables[k].stream->first;
            if (channel < 0 || channel >= tables[k].stream->channels) continue;
            Places to = {.poles = slopes + used};
            to.delays = to.poles + (size_t)coordinates * ld;
            to.b = several ? to.delays + (size_t)delays * ld : linear + used;
            to.x0 = to.b + (size_t)states * s->nu * ld;
            to.c = several ? linear + used : NULL;
            to.D = linear + used + (size_t)ld * (several ? states : shared);
            to.y0 = to.D + (size_t)nd * ld;
            to.error = slopes + used + (size_t)moving * ld;
            derivatives(tables + k, &m, &by, channel, ld, &to);
            used += tables[k].rows;
        }
        for (int q = 0; q < moving; q++)
            squares[q] += product(slopes + (size_t)q * ld, slopes + (size_t)q * ld, used);
        for (int q = 0; q < own; q++) {
            double *column = linear + (size_t)q * ld, sum = product(column, column, used);
            double size = sum > 0.0 ? sqrt(sum) : 1.0;
            for (int row = 0; row < used; row++) column[row] /= size;
            pivots[q] = 0;
        }
        if (own && used) {
            geqp3(&used, &own, linear, &ld, pivots, tau, tau + own, &room, &info);
            while (rank < least(own, used)
                   && fabs(linear[(size_t)rank * ld + rank]) > RANK * fabs(linear[0])) rank++;
            if (rank)
                ormqr("L", "T", &used, &all, &rank, linear, &ld, tau, slopes, &ld, tau + own,
                      &room, &info);
        }
        double *error = slopes + (size_t)moving * ld;
        squares[moving] += product(error, error, rank);
        for (int q = 0; q < moving; q++) {
            double *one = slopes + (size_t)q * ld + rank;
            gradient[q] += product(one, error + rank, used - rank);
            for (int p = 0; p <= q; p++)
                found[q * moving + p] += product(one, slopes + (size_t)p * ld + rank, used - rank);
        }
    }
    for (int q = 0; q < moving; q++)
        for (int p = 0; p < q; p++) found[p * moving + q] = found[q * moving + p];
    free(tables);
    free(slopes);
    free(pivots);
    return 0;
}
