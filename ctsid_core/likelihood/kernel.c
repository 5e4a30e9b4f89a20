// SPDX-License-Identifier: Apache-2.0
/*
 * One evaluation of the likelihood, compiled: twins of four functions of NumPy.
 *
 *     ctsid_columns  `mode_columns.py:columns_of`     records, poles, dead times -> triangles
 *     ctsid_solve    `output_error.py:_solved`        triangles -> all that is linear
 *     ctsid_errors   `output_error.py:errors_of`      columns -> measured less simulated outputs
 *     ctsid_slopes   `output_error.py:_normal`        triangles -> gradient and curvature
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
    int real, pairs, direct, slopes, trim;
} Shape;

/* A model, `modal_model.py:ModalModel`, and the mean squares of its errors, (records, ny). */
typedef struct {
    const double *poles, *delay;
    double *b, *c, *x0, *D, *y0, *power, *end;
} Model;

static Model model_of(const Samples *s, const Shape *shape, double *numbers) {
    size_t modes = shape->real + shape->pairs;
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

typedef void Geqrf(int *, int *, double *, int *, double *, double *, int *, int *);
typedef void Gelsy(int *, int *, int *, double *, int *, double *, int *, int *, double *, int *,
                   double *, int *, int *);
typedef void Syrk(char *, char *, int *, int *, double *, double *, int *, double *, double *,
                  int *);
static Geqrf *geqrf;
static Gelsy *gelsy;
static Syrk *syrk;

enum { PANEL = 32, ROWS = 1024, DEGREES = 8 };
static const double ROUNDING = 1e-24, RANK = 1e-13;

void ctsid_lapack(void *qr, void *least_squares, void *product) {
    geqrf = (Geqrf *)qr;
    gelsy = (Gelsy *)least_squares;
    syrk = (Syrk *)product;
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

/* phi_0 ... phi_count of x: `matrix_functions.py:phi`. */
static inline void phis(cplx x, int count, cplx *f) {
    double size = creal(x) * creal(x) + cimag(x) * cimag(x);
    if (size >= 1.0) {
        f[0] = cimag(x) == 0.0 ? exp(creal(x)) : cexp(x);
        cplx inverse = conj(x) / size;
        for (int j = 0; j < count; j++) f[j + 1] = (f[j] - over_factorial(j)) * inverse;
        return;
    }
    int terms = size < 1e-4 ? 7 : size < 1e-2 ? 10 : 17;
    if (cimag(x) == 0.0) {
        double t = creal(x), value = over_factorial(terms + count);
        for (int k = terms - 1; k >= 0; k--) value = value * t + over_factorial(k + count);
        f[count] = value;
        for (int j = count - 1; j >= 0; j--) f[j] = value = t * value + over_factorial(j);
        return;
    }
    cplx value = over_factorial(terms + count);
    for (int k = terms - 1; k >= 0; k--) value = value * x + over_factorial(k + count);
    f[count] = value;
    for (int j = count - 1; j >= 0; j--) f[j] = value = x * value + over_factorial(j);
}

/* A mode h later, and its derivative by the pole: (1) and (2) of `modal.py`. */
static inline void step(const cplx *f, double h, int degree, const double *u, int slopes, cplx z,
                        cplx s, cplx *later, cplx *bent) {
    cplx push = 0.0, turn = 0.0;
    double power = h;
    for (int j = 0; j <= degree; j++, power *= h) {
        push += f[j + 1] * (power * u[j]);
        if (slopes) turn += (f[j + 1] - (j + 1) * f[j + 2]) * (power * h * u[j]);
    }
    *later = f[0] * z + push;
    if (slopes) *bent = f[0] * (s + h * z) + turn;
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
    double delay, begin, u[DEGREES];
    cplx *z, *s;                    /* (modes, count of stamps) */
} Entry;

static void pass_stamps(Entry *group, int inputs, const cplx *poles, int modes, int slopes) {
    const Drive *d = group->drive;
    int low = d->count, high = 0;
    double u[DEGREES];
    cplx f[DEGREES + 2];
    for (int c = 0; c < inputs; c++) {
        low = least(low, group[c].first);
        high = most(high, group[c].end);
    }
    for (int l = 0; l < modes; l++) {
        size_t row = (size_t)l * d->count;
        for (int k = low; k < high; k++) {
            if (k > low) phis(poles[l] * (d->stamps[k] - d->stamps[k - 1]), d->degree + 1 + slopes, f);
            for (int c = 0; c < inputs; c++) {
                Entry *e = group + c;
                if (k < e->first || k >= e->end) continue;
                if (k == e->first) {
                    cplx own[DEGREES + 2];
                    double h = d->stamps[k] - e->begin;
                    phis(poles[l] * h, d->degree + 1 + slopes, own);
                    step(own, h, d->degree, e->u, slopes, 0.0, 0.0, e->z + row + k,
                         e->s + row + k);
                    continue;
                }
                for (int j = 0; j <= d->degree; j++)
                    u[j] = d->pieces[((size_t)j * d->width + e->channel) * (d->count + 1) + k];
                step(f, d->stamps[k] - d->stamps[k - 1], d->degree, u, slopes, e->z[row + k - 1],
                     e->s[row + k - 1], e->z + row + k, e->s + row + k);
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

/* Read inputs of the same delay at some times of a stream, and write their columns. */
static void read_inputs(const Samples *s, const Shape *shape, const Entry *group, int inputs,
                        int input, const cplx *poles, const double *times, int count,
                        double *table, int ld) {
    const Drive *d = group->drive;
    int modes = shape->real + shape->pairs, pos = 0;
    double u[DEGREES];
    cplx f[DEGREES + 2], z, bent = 0.0;
    for (int i = 0; i < count; i++) {
        double wanted = times[i] - group->delay;
        if (i == 0 || wanted < times[i - 1] - group->delay)
            pos = place_of(d->stamps, d->count, wanted);
        while (pos < d->count && d->stamps[pos] <= wanted) pos++;
        int start = pos <= group->first;
        double h = wanted - (start ? group->begin : d->stamps[pos - 1]);
        for (int l = 0; l < modes; l++) {
            size_t row = (size_t)l * d->count + pos - 1;
            phis(poles[l] * h, d->degree + 1 + shape->slopes, f);
            for (int c = 0; c < inputs; c++) {
                const Entry *e = group + c;
                for (int j = 0; j <= d->degree; j++)
                    u[j] = start ? e->u[j]
                        : d->pieces[((size_t)j * d->width + e->channel) * (d->count + 1) + pos];
                step(f, h, d->degree, u, shape->slopes, start ? 0.0 : e->z[row],
                     start ? 0.0 : e->s[row], &z, &bent);
                table[(size_t)place_in(s, shape, 0, 0, l, input + c) * ld + i] = creal(z);
                if (l >= shape->real)
                    table[(size_t)place_in(s, shape, 0, 1, l, input + c) * ld + i] = cimag(z);
                if (!shape->slopes) continue;
                table[(size_t)place_in(s, shape, 1, 0, l, input + c) * ld + i] = creal(bent);
                if (l >= shape->real)
                    table[(size_t)place_in(s, shape, 1, 1, l, input + c) * ld + i] = cimag(bent);
            }
        }
        for (int c = 0; c < inputs && (shape->direct || shape->slopes); c++) {
            const Entry *e = group + c;
            double value = 0.0, rate = 0.0, power = 1.0;
            for (int j = 0; j <= d->degree; j++) {
                u[j] = start ? e->u[j]
                    : d->pieces[((size_t)j * d->width + e->channel) * (d->count + 1) + pos];
                value += u[j] * power * over_factorial(j);
                if (j < d->degree)
                    rate += power * over_factorial(j) * (start ? e->u[j + 1]
                        : d->pieces[((size_t)(j + 1) * d->width + e->channel) * (d->count + 1)
                                    + pos]);
                power *= h;
            }
            double *column = table + (size_t)(of_modes(s, shape) + input + c) * ld + i;
            *column = value;
            if (!(shape->direct && shape->slopes)) continue;
            if (d->degree == 0 && d->count) {
                int between = pos;      /* at most one more or less */
                while (between > 0 && between - 1 < d->count - 1
                       && d->between[between - 1] >= wanted) between--;
                while (between < d->count - 1 && d->between[between] < wanted) between++;
                between = least(between, d->count - 1);
                rate = d->rates[(size_t)e->channel * d->count + between];
            }
            column[(size_t)s->nu * ld] = rate;
        }
    }
}

/* Write the columns of some samples of a stream, outputs beside. */
static void fill(const Samples *s, const Shape *shape, const Record *record, const Entry *entries,
                 const cplx *poles, const Stream *stream, int from, int count, double *table,
                 int ld) {
    const double *times = stream->times + from;
    int width = width_of(s, shape), modes = shape->real + shape->pairs;
    for (int j = 0; j < s->nu;) {
        int same = 1;
        while (j + same < s->nu && entries[j + same].drive == entries[j].drive
               && entries[j + same].delay == entries[j].delay) same++;
        read_inputs(s, shape, entries + j, same, j, poles, times, count, table, ld);
        j += same;
    }
    for (int l = 0; l < modes; l++)
        for (int i = 0; i < count; i++) {
            double since = times[i] - record->start;
            cplx free = l < shape->real ? exp(creal(poles[l]) * since) : cexp(poles[l] * since);
            for (int imag = 0; imag < 1 + (l >= shape->real); imag++) {
                double value = imag ? cimag(free) : creal(free);
                table[(size_t)place_in(s, shape, 0, imag, l, s->nu) * ld + i] = value;
                if (shape->slopes)
                    table[(size_t)place_in(s, shape, 1, imag, l, s->nu) * ld + i] = since * value;
            }
        }
    for (int i = 0; i < count; i++) table[(size_t)(width - 1) * ld + i] = 1.0;
    for (int k = 0; k < stream->channels; k++)
        for (int i = 0; i < count; i++)
            table[(size_t)(width + k) * ld + i] =
                stream->y[(size_t)(from + i) * stream->channels + k];
}

/* The triangle of a stream's columns, from blocks of rows that stay in the cache. */
static int turned(const Samples *s, const Shape *shape, const Record *record,
                  const Entry *entries, const cplx *poles, const Stream *stream, double *table) {
    int columns = width_of(s, shape) + stream->channels, block = most(ROWS, 2 * columns);
    int ld = columns + least(block, stream->count), have = 0, info, room = PANEL * columns;
    double *stack = malloc(sizeof(double) * ((size_t)ld * columns + columns + room));
    if (!stack) return 1;
    double *tau = stack + (size_t)ld * columns, *work = tau + columns;
    for (int from = 0; from < stream->count; from += block) {
        int count = least(block, stream->count - from), rows = have + count;
        fill(s, shape, record, entries, poles, stream, from, count, stack + have, ld);
        geqrf(&rows, &columns, stack, &ld, tau, work, &room, &info);
        have = least(rows, columns);
        for (int q = 0; q < have - 1; q++)
            memset(stack + (size_t)q * ld + q + 1, 0, sizeof(double) * (have - 1 - q));
    }
    for (int q = 0; q < columns; q++)
        memcpy(table + (size_t)q * columns, stack + (size_t)q * ld, sizeof(double) * columns);
    free(stack);
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
        for (int k = 0; k < record->drives; k++)
            room += 2 * (size_t)modes * s->drive[record->drive + k].count
                * s->drive[record->drive + k].width;
        Entry *entries = malloc(sizeof(Entry) * (s->nu + 1));
        cplx *states = malloc(sizeof(cplx) * (room + 1)), *at = states;
        if (!entries || !states) {
            free(entries);
            free(states);
            return 1;
        }
        for (int k = 0, j = 0; k < record->drives; k++) {
            const Drive *d = s->drive + record->drive + k;
            for (int c = 0; c < d->width; c++, j++) {
                Entry *e = entries + j;
                *e = (Entry){.drive = d, .channel = c, .delay = delay[j],
                             .begin = record->start - delay[j], .z = at,
                             .s = at + (size_t)modes * d->count};
                at += 2 * (size_t)modes * d->count;
                e->first = place_of(d->stamps, d->count, e->begin);
                e->end = place_of(d->stamps, d->count, last - delay[j]);
                polynomial(d, c, e->first, e->begin, e->u);
                first[r * s->nu + j] = e->u[0];
            }
            pass_stamps(entries + j - d->width, d->width, p, modes, shape->slopes);
        }
        for (int k = 0; k < record->streams && !failed; k++, rows++) {
            const Stream *stream = s->stream + record->stream + k;
            int columns = width_of(s, shape) + stream->channels;
            if (*rows < stream->count)
                failed = turned(s, shape, record, entries, p, stream, tables);
            else
                fill(s, shape, record, entries, p, stream, 0, stream->count, tables,
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
    int pair = mode >= t->shape->real;
    double re = creal(weight), im = cimag(weight);
    add(t, place_in(t->s, t->shape, slope, 0, mode, input), imag ? -im : re, to);
    if (pair) add(t, place_in(t->s, t->shape, slope, 1, mode, input), imag ? -re : -im, to);
}

/* Add what all that drives a mode makes of it, times a weight. */
static void add_driven(const Table *t, const Model *m, int slope, int mode, cplx weight, int imag,
                       double *to) {
    int nu = t->s->nu, modes = t->shape->real + t->shape->pairs;
    for (int j = 0; j < nu; j++)
        add_response(t, slope, mode, j, weight * ((cplx *)m->b)[mode * nu + j], imag, to);
    add_response(t, slope, mode, nu,
                 weight * ((cplx *)m->x0)[t->stream->record * modes + mode], imag, to);
}

static int input_place(const Table *t) { return of_modes(t->s, t->shape); }
static int one_place(const Table *t) { return width_of(t->s, t->shape) - 1; }

/* Errors of an output: measured less simulated. */
static void error_of(const Table *t, const Model *m, int k, double *error) {
    int nu = t->s->nu, ny = t->s->ny, modes = t->shape->real + t->shape->pairs;
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
    int rank, info, one = 1, room = 4 * columns + 1 + PANEL * (columns + 1) + 2 + most(rows, 2);
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

static int states_of(const Shape *shape) { return shape->real + 2 * shape->pairs; }

/* Complex coefficients of modes from real ones, all real parts before imaginary. */
static cplx coefficient(const Shape *shape, const double *theta, int stride, int mode) {
    int modes = shape->real + shape->pairs, pair = mode - shape->real;
    return theta[mode * stride] + (pair < 0 ? 0.0 : I * theta[(modes + pair) * stride]);
}

static int solve_c(const Table *tables, Model *m, const double *power) {
    const Samples *s = tables->s;
    const Shape *shape = tables->shape;
    int modes = shape->real + shape->pairs, n = states_of(shape), nd = s->nu * shape->direct;
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
            if (l >= shape->real)
                add_driven(t, m, 0, l, 1.0, 1, matrix + (size_t)(modes + l - shape->real) * ld + at);
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
            double weight = 1.0 / sqrt(power[t->stream->record * s->ny + i]);
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
    int modes = shape->real + shape->pairs, n = states_of(shape), nu = s->nu, ny = s->ny;
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
            double weight = 1.0 / sqrt(power[r * ny + i]), *to = matrix + at;
            for (int l = 0; l < modes; l++) {
                cplx c = weight * ((cplx *)m->c)[i * modes + l];
                for (int imag = 0; imag < 1 + (l >= shape->real); imag++) {
                    int row = imag ? modes + l - shape->real : l;
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
    int modes = shape->real + shape->pairs, nu = s->nu;
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

/* ---- Gauss-Newton ------------------------------------------------------------------------- */

/*
 * numbers: a model with the power of its errors, then the derivatives of modes by the coordinates
 * of the poles, (coordinates, modes), then the inputs whose dead times are free. first: the inputs
 * at the start. found: the gradient, then the curvature; zero on entry.
 */
int ctsid_slopes(const Samples *s, const Shape *shape, const int *rows, const double *values,
                 const double *first, double *numbers, int coordinates, int delays, int count,
                 double *found) {
    Model given = model_of(s, shape, numbers), *m = &given;
    double *gradient = found, *curvature = found + count;
    const double *power = given.power, *dp = given.end;
    const double *late = dp + 2 * (size_t)coordinates * (shape->real + shape->pairs);
    int modes = shape->real + shape->pairs, n = states_of(shape), nu = s->nu, ny = s->ny;
    int nd = nu * shape->direct, own = n + nd + s->records * shape->trim, longest = 1;
    int shared = coordinates + delays + n * nu, active = shared + n + n + nd + shape->trim;
    const cplx *p = (const cplx *)m->poles, *b = (cplx *)m->b, *turn = (const cplx *)dp;
    for (int k = 0; k < s->streams; k++) longest = most(longest, rows[k]);
    Table *tables = malloc(sizeof(Table) * (s->streams + 1));
    int *places = malloc(sizeof(int) * active);
    double *J = malloc(sizeof(double) * ((size_t)longest * (active + 1) + (size_t)active * active));
    int failed = !tables || !places || !J;
    if (!failed) tables_of(s, shape, rows, values, tables);
    for (int k = 0; k < s->streams && !failed; k++) {
        const Table *t = tables + k;
        int r = t->stream->record, ld = t->rows;
        double *error = J + (size_t)longest * active, *product = error + longest;
        if (ld < 1) continue;
        for (int channel = 0; channel < t->stream->channels; channel++) {
            int i = t->stream->first + channel, at = 0;
            const cplx *c = (cplx *)m->c + i * modes;
            double weight = 1.0 / sqrt(fmax(power[r * ny + i], ROUNDING));
            memset(J, 0, sizeof(double) * (size_t)ld * active);
            for (int q = 0; q < coordinates; q++, at++) {
                places[at] = q;
                for (int l = 0; l < modes; l++)
                    if (turn[q * modes + l] != 0.0)
                        add_driven(t, m, 1, l, weight * c[l] * turn[q * modes + l], 0,
                                   J + (size_t)at * ld);
            }
            for (int q = 0; q < delays; q++, at++) {
                int j = (int)late[q];
                cplx direct = 0.0;
                places[at] = at;
                for (int l = 0; l < modes; l++) {
                    cplx moved = weight * c[l] * b[l * nu + j];
                    direct += moved;
                    add_response(t, 0, l, nu, moved * first[r * nu + j], 0, J + (size_t)at * ld);
                    add_response(t, 0, l, j, -moved * p[l], 0, J + (size_t)at * ld);
                }
                add(t, input_place(t) + j, -creal(direct), J + (size_t)at * ld);
                if (shape->direct)
                    add(t, input_place(t) + nu + j, -weight * m->D[i * nu + j],
                        J + (size_t)at * ld);
            }
            for (int imag = 0; imag < 2; imag++)
                for (int l = imag ? shape->real : 0; l < modes; l++)
                    for (int j = 0; j < nu; j++, at++) {
                        places[at] = at;
                        add_response(t, 0, l, j, weight * c[l], imag, J + (size_t)at * ld);
                    }
            for (int imag = 0, q = 0; imag < 2; imag++)
                for (int l = imag ? shape->real : 0; l < modes; l++, at++, q++) {
                    places[at] = shared + r * n + q;
                    add_response(t, 0, l, nu, weight * c[l], imag, J + (size_t)at * ld);
                }
            int mine = shared + s->records * n + own * i;
            for (int imag = 0, q = 0; imag < 2; imag++)
                for (int l = imag ? shape->real : 0; l < modes; l++, at++, q++) {
                    places[at] = mine + q;
                    add_driven(t, m, 0, l, weight, imag, J + (size_t)at * ld);
                }
            for (int j = 0; j < nd; j++, at++) {
                places[at] = mine + n + j;
                add(t, input_place(t) + j, weight, J + (size_t)at * ld);
            }
            if (shape->trim) {
                places[at] = mine + n + nd + r;
                add(t, one_place(t), weight, J + (size_t)at++ * ld);
            }
            error_of(t, m, channel, error);
            double one = 1.0, none = 0.0;
            syrk("U", "T", &at, &ld, &one, J, &ld, &none, product, &at);
            for (int x = 0; x < at; x++) {
                double sum = 0.0, *column = J + (size_t)x * ld;
                for (int row = 0; row < ld; row++) sum += column[row] * error[row];
                gradient[places[x]] += weight * sum;
                for (int y = 0; y <= x; y++) {
                    double entry = product[(size_t)x * at + y];
                    curvature[(size_t)places[x] * count + places[y]] += entry;
                    if (x != y) curvature[(size_t)places[y] * count + places[x]] += entry;
                }
            }
        }
    }
    free(tables);
    free(places);
    free(J);
    return failed;
}
