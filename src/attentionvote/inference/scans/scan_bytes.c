/* Two loops over untrusted bytes that Python is too slow for: LZF decompression and rows of decimal numbers.
 *
 * Plain C99, called through ctypes (lzf.py, number_rows.py), which also hold the slow versions that serve where nothing
 * is compiled and that the tests compare with, bit by bit. Both functions work through a bounded piece and return, so
 * that the caller can look at its clock; what they have done is in `state`. Every read and write is checked against
 * the sizes given. Compiled with -ffinite-math-only: NaN and infinity are only ever handled as bits.
 */
#include <stdint.h>
#include <string.h>

#define MOST_DIGITS 19          /* always fit 64 bits */
#define MOST_FIELD_BYTES 320    /* of a number; as number_rows.py */
#define EXACT_POWER 22          /* largest power of ten that a double holds exactly */
#define LARGEST_EXACT (1ull << 53)
#define SLACK 0x1p-50           /* covers dropped digits and four roundings in double precision */
#define NAN_BITS 0x7fc00000u
#define INF_BITS 0x7f800000u

enum { AT, DONE, FAULT, DETAIL, UNDECIDED };  /* of state */
enum { FINE, EARLY_END, BEFORE_BEGINNING };   /* faults of LZF */
enum { OTHER_WIDTH = 1, NO_NUMBER };          /* faults of rows */

/* Unpacks until `stop` bytes of `out` are written or the input is at fault. state: AT in, DONE out, FAULT. */
int lzf_block(const uint8_t *in, int64_t in_size, uint8_t *out, int64_t out_size, int64_t stop, int64_t *state) {
    int64_t at = state[AT], done = state[DONE];
    int64_t fault = FINE;
    if (stop > out_size) stop = out_size;
    while (done < stop) {
        if (at >= in_size) {
            fault = EARLY_END;
            break;
        }
        const int control = in[at++];
        if (control < 32) {
            int64_t count = control + 1;
            if (count > in_size - at) {
                fault = EARLY_END;
                break;
            }
            const int64_t fit = count < out_size - done ? count : out_size - done;
            memcpy(out + done, in + at, (size_t)fit);
            at += count;
            done += fit;
            continue;
        }
        int64_t count = control >> 5;
        if (count == 7) {
            if (at >= in_size) {
                fault = EARLY_END;
                break;
            }
            count += in[at++];
        }
        count += 2;
        if (at >= in_size) {
            fault = EARLY_END;
            break;
        }
        const int64_t back = ((int64_t)(control & 31) << 8 | in[at++]) + 1;
        if (back > done) {
            fault = BEFORE_BEGINNING;
            break;
        }
        if (count > out_size - done) count = out_size - done;
        for (int64_t i = 0; i < count; i++, done++) out[done] = out[done - back]; /* may repeat what it writes */
    }
    state[AT] = at;
    state[DONE] = done;
    state[FAULT] = fault;
    return 0;
}

static const double POWERS[EXACT_POWER + 1] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                                               1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};

static double scaled(double value, int power) {
    for (; power > EXACT_POWER; power -= EXACT_POWER) value *= POWERS[EXACT_POWER];
    for (; power < -EXACT_POWER; power += EXACT_POWER) value /= POWERS[EXACT_POWER];
    return power < 0 ? value / POWERS[-power] : value * POWERS[power];
}

static uint32_t bits_of(double value) {
    const float single = (float)value;
    uint32_t bits;
    memcpy(&bits, &single, 4);
    return bits;
}

static int is_word(const uint8_t *p, const uint8_t *end, const char *word) {
    for (; *word; p++, word++)
        if (p == end || (*p | 32) != *word) return 0;
    return p == end;
}

static int is_digit(uint8_t c) { return c >= '0' && c <= '9'; }

/* float32(float64(text)) as bits. Returns 0; 1 when it is no number; 2 when only exact arithmetic can tell. */
static int parsed(const uint8_t *p, const uint8_t *end, uint32_t *bits) {
    if (end - p > MOST_FIELD_BYTES) return 1;
    const uint32_t sign = p < end && *p == '-' ? 0x80000000u : 0;
    if (p < end && (*p == '-' || *p == '+')) p++;
    uint64_t digits = 0;
    int count = 0, any = 0, power = 0, dropped = 0, point = 0;
    for (; p < end; p++) {
        if (*p == '.' && !point) {
            point = 1;
            continue;
        }
        if (!is_digit(*p)) break;
        any = 1;
        if (count < MOST_DIGITS) {
            digits = digits * 10 + (uint64_t)(*p - '0');
            count += digits != 0; /* leading zeros are no digits */
            power -= point;
        } else {
            dropped |= *p != '0';
            power += !point;
        }
    }
    if (!any) {
        const int infinite = is_word(p, end, "inf") || is_word(p, end, "infinity");
        if (point || !(infinite || is_word(p, end, "nan"))) return 1;
        *bits = infinite ? sign | INF_BITS : NAN_BITS;
        return 0;
    }
    if (p < end && (*p | 32) == 'e') {
        p++;
        const int minus = p < end && *p == '-';
        if (p < end && (*p == '-' || *p == '+')) p++;
        if (p == end) return 1;
        int exponent = 0;
        for (; p < end && is_digit(*p); p++)
            if (exponent < 100000) exponent = exponent * 10 + (*p - '0');
        power += minus ? -exponent : exponent;
    }
    if (p != end) return 1;
    if (digits == 0) {
        *bits = sign;
        return 0;
    }
    if (power < -2 * EXACT_POWER || power > 2 * EXACT_POWER) return 2;
    const double value = scaled((double)digits, power);
    if (!dropped && digits <= LARGEST_EXACT && power >= -EXACT_POWER && power <= EXACT_POWER) {
        *bits = sign | bits_of(value); /* one rounding of exact values: the nearest double */
        return 0;
    }
    /* Rounding is monotone: where both ends of what the value can be give the same float, so does the value. */
    const uint32_t low = bits_of(value * (1 - SLACK)), high = bits_of(value * (1 + SLACK));
    *bits = sign | low;
    return low == high ? 0 : 2;
}

static int is_blank(uint8_t c) { return c == ' ' || c == '\t' || c == '\v' || c == '\f'; }
static int is_line_end(uint8_t c) { return c == '\n' || c == '\r'; }

/* Reads up to `rows` rows and about `stop` bytes of text; empty lines are no rows.
 *
 * width: fields that a row must have, 0: any. columns: three indices of fields, -1: none. mark: what separates fields,
 * 0: blanks. out: (rows, 3). undecided: (row, axis, first byte, end) of numbers for the caller to convert, at most
 * `most_undecided`. state: AT, DONE rows, FAULT, DETAIL, UNDECIDED; a row at fault is the one behind the last one done.
 */
int number_rows(const uint8_t *text, int64_t size, int64_t width, const int64_t *columns, int32_t mark, int64_t rows,
                int64_t stop, uint32_t *out, int64_t *undecided, int64_t most_undecided, int64_t *state) {
    int64_t at = state[AT], done = 0, open = 0;
    const int64_t first = at;
    state[FAULT] = FINE;
    while (done < rows && at < size && at - first < stop && open + 3 <= most_undecided) {
        while (at < size && (is_blank(text[at]) || is_line_end(text[at]))) at++;
        if (at == size) break;
        int64_t field = 0;
        int fault = FINE;
        const int64_t before = open;
        while (at < size && !is_line_end(text[at])) {
            int64_t start = at, end;
            if (mark) {
                while (at < size && !is_line_end(text[at]) && text[at] != mark) at++;
                end = at;
                while (start < end && is_blank(text[start])) start++;
                while (end > start && is_blank(text[end - 1])) end--;
                const int closed = at < size && text[at] == mark;
                at += closed;
                if (!closed && start == end) break; /* a mark may stand behind the last field */
            } else {
                while (at < size && !is_line_end(text[at]) && !is_blank(text[at])) at++;
                end = at;
                while (at < size && is_blank(text[at])) at++;
            }
            for (int axis = 0; axis < 3; axis++) {
                if (columns[axis] != field) continue;
                const int kind = parsed(text + start, text + end, out + 3 * done + axis);
                if (kind == 1) fault = NO_NUMBER;
                if (kind == 2 && open < most_undecided) {
                    const int64_t entry[4] = {done, axis, start, end};
                    memcpy(undecided + 4 * open++, entry, sizeof entry);
                }
            }
            field++;
        }
        if (width && field != width) fault = OTHER_WIDTH;
        if (fault) {
            open = before;
            state[FAULT] = fault;
            state[DETAIL] = field;
            break;
        }
        if (at < size && text[at] == '\r') at++;
        if (at < size && text[at] == '\n') at++;
        done++;
    }
    state[AT] = at;
    state[DONE] = done;
    state[UNDECIDED] = open;
    return 0;
}
