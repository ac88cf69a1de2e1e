/* The native protocol of tactile_rt, version 1, for firmware: see ../native-protocol.md.
 *
 * C99 (and C++), one header, no allocation, nothing of the C library but <string.h>. A part that
 * is not called costs nothing. Every byte is written by shifts, so that it works on either
 * endianness; float must be IEEE 754 of 32 bits. Nothing here blocks, except what your own `write`
 * and `send` do.
 *
 *   samples over a serial line   trn_sample_f32, trn_sample_i16   into a buffer, for DMA
 *   samples over a CAN bus       trn_can_f32, trn_can_i16         frame by frame, to `send`
 *   commands of the host         trn_parse + trn_answer, trn_can_answer
 */
#ifndef TACTILE_RT_NATIVE_H
#define TACTILE_RT_NATIVE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define TRN_VERSION 1u
#define TRN_HEADER_SIZE 20u
#define TRN_CRC_SIZE 4u
#define TRN_COMMAND_MAX 32u /* longest payload of a command that a device takes */

/* Bytes of validity bits of so many elements; bytes of a serial sample, to size buffers by. */
#define TRN_MASK_SIZE(elements) (((size_t)(elements) + 7u) / 8u)
#define TRN_SAMPLE_SIZE(elements, channels, bytes_per_value)                             \
    (TRN_HEADER_SIZE + TRN_MASK_SIZE(elements) +                                         \
     (size_t)(elements) * (size_t)(channels) * (size_t)(bytes_per_value) + TRN_CRC_SIZE)

enum { /* types of messages */
    TRN_SAMPLE = 0,
    TRN_DESCRIBE = 1,
    TRN_DESCRIPTION = 2,
    TRN_START = 3,
    TRN_STOP = 4,
    TRN_WHISK = 5,
    TRN_ACK = 6
};
enum { TRN_FLOAT32 = 0, TRN_INT16 = 1 };              /* formats of serial samples */
enum { TRN_OK = 0, TRN_UNKNOWN = 1, TRN_IMPOSSIBLE = 2 }; /* what an ACK says */
enum { /* bits of the status */
    TRN_OVERRANGE = 1,
    TRN_SENSOR_FAILS = 2,
    TRN_SAMPLES_LOST = 4,
    TRN_WHISKING_FAILS = 8
};

/* What comes with the values of one sample. */
typedef struct {
    uint8_t elements, channels;
    uint16_t status;      /* TRN_OVERRANGE ..; bits 8 to 15 are your own, and not sent over CAN */
    uint32_t seq;         /* counts the samples taken, also those that could not be sent */
    uint32_t time_us;     /* when it was taken; wraps around */
    const uint8_t *valid; /* TRN_MASK_SIZE bytes, the first element lowest; NULL: all are valid */
} trn_sample;

/* What a device is, and what it was told. */
typedef struct {
    const char *description; /* JSON; NULL: it has none */
    uint16_t description_size;
    uint8_t whisks;    /* whether it has whiskers that move */
    uint8_t streaming; /* set by START and STOP */
    float whisking[3]; /* set by WHISK: frequency in Hz, amplitude and offset in rad */
} trn_device;

typedef void (*trn_write)(void *to, const uint8_t *data, size_t n);
typedef void (*trn_send)(void *to, uint32_t id, const uint8_t *data, uint8_t n);

/* ------------------------------------------------------------------------ bytes and checksums */

static inline uint8_t *trn_put16(uint8_t *at, uint16_t v) {
    at[0] = (uint8_t)(v & 0xFFu);
    at[1] = (uint8_t)(v >> 8);
    return at + 2;
}

static inline uint8_t *trn_put32(uint8_t *at, uint32_t v) {
    return trn_put16(trn_put16(at, (uint16_t)(v & 0xFFFFu)), (uint16_t)(v >> 16));
}

static inline uint16_t trn_get16(const uint8_t *at) {
    return (uint16_t)(at[0] | (uint16_t)(at[1] << 8));
}

static inline uint32_t trn_get32(const uint8_t *at) {
    return trn_get16(at) | (uint32_t)trn_get16(at + 2) << 16;
}

static inline uint32_t trn_bits_of(float v) {
    uint32_t bits;
    memcpy(&bits, &v, sizeof bits);
    return bits;
}

static inline float trn_float_of(uint32_t bits) {
    float v;
    memcpy(&v, &bits, sizeof v);
    return v;
}

static inline int trn_is_finite(float v) {
    return (trn_bits_of(v) & 0x7F800000u) != 0x7F800000u;
}

/* CRC-16/XMODEM, four bits at a time; begin with 0 and go on with what it returned ("123456789"
 * gives 0x31C3). */
static inline uint16_t trn_crc16(uint16_t crc, const uint8_t *data, size_t n) {
    static const uint16_t table[16] = {0x0000, 0x1021, 0x2042, 0x3063, 0x4084, 0x50A5,
                                       0x60C6, 0x70E7, 0x8108, 0x9129, 0xA14A, 0xB16B,
                                       0xC18C, 0xD1AD, 0xE1CE, 0xF1EF};
    while (n--) {
        crc = (uint16_t)((uint16_t)(crc << 4) ^ table[(crc >> 12) ^ (*data >> 4)]);
        crc = (uint16_t)((uint16_t)(crc << 4) ^ table[(crc >> 12) ^ (*data & 15u)]);
        data++;
    }
    return crc;
}

/* CRC-32 as of zlib, likewise ("123456789" gives 0xCBF43926). */
static inline uint32_t trn_crc32(uint32_t crc, const uint8_t *data, size_t n) {
    static const uint32_t table[16] = {0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC,
                                       0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
                                       0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C,
                                       0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C};
    crc = ~crc;
    while (n--) {
        crc = (crc >> 4) ^ table[(crc ^ *data) & 15u];
        crc = (crc >> 4) ^ table[(crc ^ (uint32_t)(*data >> 4)) & 15u];
        data++;
    }
    return ~crc;
}

/* A value as a count of int16, rounded to the nearest and saturated; what is not a number gives 0
 * (clear its element's bit of validity). `per_count` is the scale of the description. */
static inline int16_t trn_count(float value, float per_count) {
    float counts = value / per_count;
    if (counts != counts) return 0;
    if (counts >= 32767.0f) return 32767;
    if (counts <= -32767.0f) return -32767;
    return (int16_t)(counts < 0.0f ? counts - 0.5f : counts + 0.5f);
}

/* Validity bits, `i` from 0. */
static inline void trn_set_valid(uint8_t *mask, size_t i, int valid) {
    uint8_t bit = (uint8_t)(1u << (i & 7u));
    mask[i / 8u] = (uint8_t)(valid ? mask[i / 8u] | bit : mask[i / 8u] & ~bit);
}

/* One byte of a sample's validity bits, the unused ones of the last byte 0. */
static inline uint8_t trn_mask_byte(const trn_sample *s, size_t i) {
    unsigned rest = s->elements - 8u * (unsigned)i; /* elements from this byte on */
    unsigned used = rest >= 8u ? 0xFFu : (1u << rest) - 1u;
    return (uint8_t)((s->valid ? s->valid[i] : 0xFFu) & used);
}

/* --------------------------------------------------------------------------------- serial line */

/* A header with its checksum: TRN_HEADER_SIZE bytes. */
static inline void trn_header(uint8_t *out, uint8_t type, uint8_t format, uint16_t length,
                              const trn_sample *s) {
    out[0] = 'T';
    out[1] = 'R';
    out[2] = (uint8_t)(TRN_VERSION << 4 | type);
    out[3] = format;
    trn_put16(out + 4, length);
    trn_put16(out + 6, s ? s->status : 0);
    trn_put32(out + 8, s ? s->seq : 0);
    trn_put32(out + 12, s ? s->time_us : 0);
    out[16] = s ? s->elements : 0;
    out[17] = s ? s->channels : 0;
    trn_put16(out + 18, trn_crc16(0, out + 2, 16));
}

/* A whole message from a payload that lies ready. Returns its size; 0: no room. */
static inline size_t trn_frame(uint8_t *out, size_t room, uint8_t type, const uint8_t *payload,
                               uint16_t length) {
    size_t size = TRN_HEADER_SIZE + (size_t)length;
    if (room < size + TRN_CRC_SIZE) return 0;
    trn_header(out, type, 0, length, NULL);
    if (length) memcpy(out + TRN_HEADER_SIZE, payload, length);
    trn_put32(out + size, trn_crc32(0, out, size));
    return size + TRN_CRC_SIZE;
}

/* Header and validity of a sample; returns where its values go, NULL: no room or no such sample. */
static inline uint8_t *trn_begin(uint8_t *out, size_t room, const trn_sample *s, uint8_t format) {
    size_t mask = TRN_MASK_SIZE(s->elements), i;
    size_t width = format == TRN_INT16 ? 2u : 4u;
    size_t length = mask + (size_t)s->elements * s->channels * width;
    if (!s->elements || !s->channels || length > 0xFFFFu ||
        room < TRN_HEADER_SIZE + length + TRN_CRC_SIZE)
        return NULL;
    trn_header(out, TRN_SAMPLE, format, (uint16_t)length, s);
    for (i = 0; i < mask; i++) out[TRN_HEADER_SIZE + i] = trn_mask_byte(s, i);
    return out + TRN_HEADER_SIZE + mask;
}

static inline size_t trn_end(uint8_t *out, uint8_t *end) {
    size_t size = (size_t)(end - out);
    trn_put32(end, trn_crc32(0, out, size));
    return size + TRN_CRC_SIZE;
}

/* One sample of elements x channels values, element by element, in SI units. Returns the number of
 * bytes written, which is TRN_SAMPLE_SIZE(elements, channels, 4); 0: no room. */
static inline size_t trn_sample_f32(uint8_t *out, size_t room, const trn_sample *s,
                                    const float *values) {
    uint8_t *at = trn_begin(out, room, s, TRN_FLOAT32);
    size_t n = (size_t)s->elements * s->channels, i;
    if (!at) return 0;
    for (i = 0; i < n; i++) at = trn_put32(at, trn_bits_of(values[i]));
    return trn_end(out, at);
}

/* The same in counts, whose scales the description gives: TRN_SAMPLE_SIZE(.., .., 2) bytes. */
static inline size_t trn_sample_i16(uint8_t *out, size_t room, const trn_sample *s,
                                    const int16_t *counts) {
    uint8_t *at = trn_begin(out, room, s, TRN_INT16);
    size_t n = (size_t)s->elements * s->channels, i;
    if (!at) return 0;
    for (i = 0; i < n; i++) at = trn_put16(at, (uint16_t)counts[i]);
    return trn_end(out, at);
}

/* A command of the host. */
typedef struct {
    uint8_t type;
    uint8_t length;
    uint8_t payload[TRN_COMMAND_MAX];
} trn_command;

/* What has come of commands; all zero to begin. */
typedef struct {
    uint8_t data[TRN_HEADER_SIZE + TRN_COMMAND_MAX + TRN_CRC_SIZE];
    uint8_t n;
} trn_parser;

static inline void trn_drop(trn_parser *p, size_t n) {
    p->n = (uint8_t)(p->n - n);
    memmove(p->data, p->data + n, p->n);
}

/* Take bytes until a command is complete; advances `data` and `n` past what was taken. Returns 1
 * with a command, 0 when all is taken. Call it until it returns 0. Damaged bytes are passed over,
 * and so is a message whose payload is longer than TRN_COMMAND_MAX. */
static inline int trn_parse(trn_parser *p, const uint8_t **data, size_t *n, trn_command *found) {
    for (;;) {
        size_t length, size;
        while (p->n && (p->data[0] != 'T' || (p->n > 1u && p->data[1] != 'R'))) trn_drop(p, 1);
        size = TRN_HEADER_SIZE;
        if (p->n >= TRN_HEADER_SIZE) {
            length = trn_get16(p->data + 4);
            if (trn_crc16(0, p->data + 2, 16) != trn_get16(p->data + 18) ||
                length > TRN_COMMAND_MAX) {
                trn_drop(p, 1);
                continue;
            }
            size += length + TRN_CRC_SIZE;
            if (p->n >= size) {
                size_t body = size - TRN_CRC_SIZE;
                if (trn_crc32(0, p->data, body) != trn_get32(p->data + body)) {
                    trn_drop(p, 1);
                    continue;
                }
                found->type = p->data[2];
                found->length = (uint8_t)length;
                memcpy(found->payload, p->data + TRN_HEADER_SIZE, length);
                trn_drop(p, size);
                if (found->type >> 4 != TRN_VERSION) continue;
                found->type &= 15u;
                return 1;
            }
        }
        if (!*n) return 0;
        p->data[p->n++] = *(*data)++;
        --*n;
    }
}

/* Do what START, STOP and WHISK ask; returns what the ACK says. `whisking` is NULL unless the
 * command had three values. */
static inline uint8_t trn_obey(trn_device *d, uint8_t type, const float *whisking) {
    if (type == TRN_START || type == TRN_STOP) {
        d->streaming = type == TRN_START;
        return TRN_OK;
    }
    if (type != TRN_WHISK || !whisking) return TRN_UNKNOWN;
    if (!d->whisks || !trn_is_finite(whisking[0]) || !trn_is_finite(whisking[1]) ||
        !trn_is_finite(whisking[2]))
        return TRN_IMPOSSIBLE;
    memcpy(d->whisking, whisking, sizeof d->whisking);
    return TRN_OK;
}

static inline int trn_from_device(uint8_t type) {
    return type == TRN_SAMPLE || type == TRN_DESCRIPTION || type == TRN_ACK;
}

/* Put a device's serial number (letters, digits, ._-) into a description that has none; the new
 * size, or 0 if there is no room: size + strlen(serial) + 12 bytes. */
static inline uint16_t trn_describe(char *out, size_t room, const char *text, uint16_t size,
                                    const char *serial) {
    static const char key[] = ",\"serial\":\"";
    size_t n = strlen(serial), k = sizeof key - 1u, all = size + n + k + 1u;
    if (!size || all > room || all > 65535u) return 0;
    memcpy(out, text, size - 1u); /* all but the last brace */
    memcpy(out + size - 1u, key, k);
    memcpy(out + size - 1u + k, serial, n);
    memcpy(out + size - 1u + k + n, "\"}", 2u);
    return (uint16_t)all;
}

/* Obey a command and answer it. */
static inline void trn_answer(trn_device *d, const trn_command *c, trn_write write, void *to) {
    uint8_t out[TRN_HEADER_SIZE + 2u + TRN_CRC_SIZE], ack[2];
    float asked[3];
    size_t i;
    if (trn_from_device(c->type)) return; /* an echo: answering answers would never end */
    ack[0] = c->type;
    if (c->type == TRN_DESCRIBE && d->description) {
        const uint8_t *text = (const uint8_t *)d->description;
        uint32_t crc;
        trn_header(out, TRN_DESCRIPTION, 0, d->description_size, NULL);
        crc = trn_crc32(trn_crc32(0, out, TRN_HEADER_SIZE), text, d->description_size);
        write(to, out, TRN_HEADER_SIZE);
        write(to, text, d->description_size);
        trn_put32(out, crc);
        write(to, out, TRN_CRC_SIZE);
        return;
    }
    if (c->type == TRN_DESCRIBE) {
        ack[1] = TRN_IMPOSSIBLE;
    } else if (c->length == sizeof asked) {
        for (i = 0; i < 3u; i++) asked[i] = trn_float_of(trn_get32(c->payload + 4u * i));
        ack[1] = trn_obey(d, c->type, asked);
    } else {
        ack[1] = trn_obey(d, c->type, NULL);
    }
    write(to, out, trn_frame(out, sizeof out, TRN_ACK, ack, 2));
}

/* ------------------------------------------------------------------------------------ CAN bus */

enum { /* identifiers from the base */
    TRN_CAN_COMMAND = 0,
    TRN_CAN_ACK = 1,
    TRN_CAN_HEADER = 2,
    TRN_CAN_PART = 3,
    TRN_CAN_DESCRIPTION = 4
};
enum { TRN_CAN_IS_FLOAT32 = 1, TRN_CAN_IS_LONG = 2 }; /* flags of a header; and inverted << 4 */

/* A bus: `send` must queue frames first-in-first-out (a controller that picks the lowest
 * identifier first must be told not to) and wait or fail when it is full; where it fails, count the
 * sample and set TRN_SAMPLES_LOST in the next. */
typedef struct {
    uint32_t base; /* the first of five identifiers of 11 bits; the host's `base` */
    uint8_t fd;    /* frames of CAN FD, to 64 bytes */
    trn_send send;
    void *to;
} trn_can;

/* A frame being filled. */
typedef struct {
    const trn_can *can;
    uint32_t id;
    uint8_t data[64];
    uint8_t n, head; /* bytes so far; bytes before the payload */
    uint16_t index, crc;
} trn_filler;

static inline void trn_can_send(const trn_can *can, uint32_t which, uint8_t *data, uint8_t n) {
    static const uint8_t sizes[8] = {8, 12, 16, 20, 24, 32, 48, 64};
    size_t i = 0;
    if (n > 8u) { /* only CAN FD gets here: it has no other lengths */
        while (sizes[i] < n) i++;
        memset(data + n, 0, (size_t)sizes[i] - n);
        n = sizes[i];
    }
    can->send(can->to, can->base + which, data, n);
}

static inline void trn_flush(trn_filler *f) {
    if (f->id == TRN_CAN_PART)
        f->data[1] = (uint8_t)f->index;
    else
        trn_put16(f->data + 1, f->index);
    trn_can_send(f->can, f->id, f->data, f->n);
    f->n = f->head;
    f->index++;
}

static inline void trn_fill(trn_filler *f, const uint8_t *data, size_t n) {
    f->crc = trn_crc16(f->crc, data, n);
    while (n--) {
        f->data[f->n++] = *data++;
        if (f->n == (f->can->fd ? 64u : 8u)) trn_flush(f);
    }
}

/* The header of a sample and its validity; returns 0 if it needs more than 256 parts. */
static inline int trn_can_begin(trn_filler *f, const trn_can *can, const trn_sample *s,
                                uint8_t flags) {
    size_t mask = TRN_MASK_SIZE(s->elements), i;
    size_t width = flags & TRN_CAN_IS_FLOAT32 ? 4u : 2u;
    size_t size = mask + (size_t)s->elements * s->channels * width + 2u;
    if (!s->elements || !s->channels || size > 256u * (can->fd ? 62u : 6u)) return 0;
    f->can = can;
    trn_put32(trn_put16(f->data, (uint16_t)(s->seq & 0xFFFFu)), s->time_us);
    f->data[6] = (uint8_t)(s->status & 0xFFu);
    flags = (uint8_t)(flags | (can->fd ? TRN_CAN_IS_LONG : 0));
    f->data[7] = (uint8_t)(flags | (~flags & 15u) << 4);
    f->crc = trn_crc16(0, f->data, 8);
    trn_can_send(can, TRN_CAN_HEADER, f->data, 8);
    f->id = TRN_CAN_PART;
    f->index = 0;
    f->n = f->head = 2;
    f->data[0] = (uint8_t)(s->seq & 0xFFu);
    for (i = 0; i < mask; i++) {
        uint8_t byte = trn_mask_byte(s, i);
        trn_fill(f, &byte, 1);
    }
    return 1;
}

/* The checksum of a sample, and what is left of it. */
static inline int trn_can_end(trn_filler *f) {
    uint8_t crc[2];
    trn_put16(crc, f->crc);
    trn_fill(f, crc, 2);
    if (f->n > f->head) trn_flush(f);
    return 1;
}

/* Send one sample. Returns 0 if it does not fit in 256 frames (of 6 bytes, or 62 of CAN FD). */
static inline int trn_can_f32(const trn_can *can, const trn_sample *s, const float *values) {
    trn_filler f;
    uint8_t four[4];
    size_t n = (size_t)s->elements * s->channels, i;
    if (!trn_can_begin(&f, can, s, TRN_CAN_IS_FLOAT32)) return 0;
    for (i = 0; i < n; i++) {
        trn_put32(four, trn_bits_of(values[i]));
        trn_fill(&f, four, 4);
    }
    return trn_can_end(&f);
}

static inline int trn_can_i16(const trn_can *can, const trn_sample *s, const int16_t *counts) {
    trn_filler f;
    uint8_t two[2];
    size_t n = (size_t)s->elements * s->channels, i;
    if (!trn_can_begin(&f, can, s, 0)) return 0;
    for (i = 0; i < n; i++) {
        trn_put16(two, (uint16_t)counts[i]);
        trn_fill(&f, two, 2);
    }
    return trn_can_end(&f);
}

static inline void trn_can_describe(const trn_can *can, const char *text, uint16_t size) {
    trn_filler f;
    uint8_t ends[4];
    f.can = can;
    f.id = TRN_CAN_DESCRIPTION;
    f.index = f.crc = 0;
    f.n = f.head = 3;
    f.data[0] = TRN_DESCRIPTION;
    trn_put16(ends, size);
    trn_fill(&f, ends, 2);
    trn_fill(&f, (const uint8_t *)text, size);
    trn_put32(ends, trn_crc32(0, (const uint8_t *)text, size));
    trn_fill(&f, ends, 4);
    if (f.n > f.head) trn_flush(&f);
}

/* Obey a frame and answer it; frames that are not commands to this device are ignored. */
static inline void trn_can_answer(trn_device *d, const trn_can *can, uint32_t id,
                                  const uint8_t *data, uint8_t n) {
    uint8_t ack[3] = {TRN_ACK, 0, TRN_OK};
    float asked[3];
    if (id != can->base + TRN_CAN_COMMAND || !n) return;
    ack[1] = data[0];
    if (data[0] == TRN_DESCRIBE) {
        if (d->description)
            trn_can_describe(can, d->description, d->description_size);
        else
            ack[2] = TRN_IMPOSSIBLE;
    } else if (data[0] == TRN_WHISK && n >= 7u) {
        asked[0] = (float)trn_get16(data + 1) * 1e-3f;
        asked[1] = (float)(int16_t)trn_get16(data + 3) * 1e-4f;
        asked[2] = (float)(int16_t)trn_get16(data + 5) * 1e-4f;
        ack[2] = trn_obey(d, TRN_WHISK, asked);
    } else {
        ack[2] = trn_obey(d, data[0], NULL);
    }
    trn_can_send(can, TRN_CAN_ACK, ack, 3);
}

#endif
