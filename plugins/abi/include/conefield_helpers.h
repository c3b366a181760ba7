/* Helpers for stages in C: texts, settings, memory, gradients and random numbers. They are not part of the contract: a
 * plugin may have its own. */
#ifndef CONEFIELD_HELPERS_H
#define CONEFIELD_HELPERS_H

#include "conefield_plugin.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Initializes a text of the contract. */
#define TEXT(literal) { (const uint8_t *)(literal), sizeof(literal) - 1 }

/* Writes a line, in the format of `printf`. */
#ifdef __GNUC__
__attribute__((format(printf, 2, 3)))
#endif
static inline void say(struct ConefieldText *out, const char *format, ...) {
    if (out == NULL) return;
    char line[512] = "";
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(line, sizeof line, format, arguments);
    va_end(arguments);
    out->length = strlen(line);
    memcpy(out->data, line, out->length < out->capacity ? out->length : out->capacity);
}

/* The number or the list of numbers under `key` of the settings: one flat JSON object, checked against the schema by the
 * host, with defaults filled in. Writes at most `most` of them to `out`; returns how many there are, 0 if the key is
 * missing. Settings that are texts or tables need a JSON parser. */
static inline size_t numbers(struct ConefieldStr settings, const char *key, double *out, size_t most) {
    char quoted[64];
    size_t count = 0;
    char *text = (char *)malloc(settings.length + 1);
    if (text == NULL) return 0;
    memcpy(text, settings.data, settings.length);
    text[settings.length] = 0;
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    const char *at = strstr(text, quoted);
    at = at == NULL ? NULL : at + strlen(quoted);
    while (at != NULL) {
        char *end = NULL;
        at += strspn(at, " [,");
        double value = strtod(at, &end);
        if (end == at) break;
        if (count < most) out[count] = value;
        count++;
        at = end + strspn(end, " ");
        /* Another key follows a number that is in no list. */
        if (*at != ',' || strspn(at, " ,\"") > strspn(at, " ,")) break;
    }
    free(text);
    return count;
}

/* The number under `key` of the settings; NaN if the key is missing. */
static inline double number(struct ConefieldStr settings, const char *key) {
    double value = NAN;
    numbers(settings, key, &value, 1);
    return value;
}

/* Passes a copy of `stage`, which has `size` bytes, to the host. Its `destroy` is `free`. */
static inline ConefieldStatus hand_over(const void *stage, size_t size, void **out, struct ConefieldText *error) {
    *out = malloc(size);
    if (*out == NULL) {
        say(error, "no memory");
        return CONEFIELD_FAILED;
    }
    memcpy(*out, stage, size);
    return CONEFIELD_OK;
}

/* Adds to the gradient of parameter `at`, if it is requested. */
static inline void add_gradient(struct ConefieldGrads grads, size_t at, float sum) {
    if (at >= grads.start && at - grads.start < grads.length) grads.data[at - grads.start] += sum;
}

/* The next random number, from -1 to below 1. */
static inline float uniform(uint64_t *seed) {
    *seed = *seed * 6364136223846793005u + 1442695040888963407u;
    return 2.0f * (float)(*seed >> 40) / 16777216.0f - 1.0f;
}

#endif
