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

/* The number under `key` of the settings: one flat JSON object, checked against the schema by the host, with defaults
 * filled in. NaN if the key is missing. Settings that are texts, lists or tables need a JSON parser. */
static inline double number(struct ConefieldStr settings, const char *key) {
    char quoted[64];
    char *text = (char *)malloc(settings.length + 1);
    if (text == NULL) return NAN;
    memcpy(text, settings.data, settings.length);
    text[settings.length] = 0;
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    const char *at = strstr(text, quoted);
    double value = at == NULL ? NAN : strtod(at + strlen(quoted), NULL);
    free(text);
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
