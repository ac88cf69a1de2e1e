/* A device over a serial line or USB: 5 whiskers, a force (N) and a moment (N m) each, 1 kHz.
 * What is declared extern below is your board's; how to make the JSON: ../native-protocol.md. */
#include "tactile_rt_native.h"

#define WHISKERS 5
#define CHANNELS 2

extern const char board_description[];
extern const uint16_t board_description_size;
extern const char board_serial[];                  /* of this one board: a chip has such a number */
extern uint32_t board_micros(void);
extern int board_running(void);                    /* a real device returns 1 for ever */
extern size_t board_read(uint8_t *data, size_t n); /* what has come, without waiting */
extern void board_write(void *to, const uint8_t *data, size_t n);
extern int board_measure(float *values, uint8_t *valid); /* 1 when a new sample was taken */

int main(void) {
    static uint8_t out[TRN_SAMPLE_SIZE(WHISKERS, CHANNELS, 4)];
    static trn_parser parser;
    static char described[4096];
    trn_device device = {described, 0, 0, 0, {0}};
    uint8_t in[64], valid[TRN_MASK_SIZE(WHISKERS)] = {0};
    float values[WHISKERS * CHANNELS];
    trn_sample sample = {WHISKERS, CHANNELS, 0, 0, 0, valid};
    trn_command command;

    device.description_size = trn_describe(described, sizeof described, board_description,
                                           board_description_size, board_serial);
    while (board_running()) {
        const uint8_t *data = in;
        size_t n = board_read(in, sizeof in);
        while (trn_parse(&parser, &data, &n, &command))
            trn_answer(&device, &command, board_write, NULL);

        sample.time_us = board_micros();
        if (board_measure(values, valid)) {
            if (device.streaming)
                board_write(NULL, out, trn_sample_f32(out, sizeof out, &sample, values));
            sample.seq++; /* counts every sample taken: what was not sent shows as a gap */
        }
    }
    return 0;
}
