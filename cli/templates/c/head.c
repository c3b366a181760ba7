#include "conefield_plugin.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TEXT(literal) { (const uint8_t *)(literal), sizeof(literal) - 1 }

/* Writes a line for people. */
static void say(struct ConefieldText *out, const char *line) {
    if (out == NULL) return;
    out->length = strlen(line);
    memcpy(out->data, line, out->length < out->capacity ? out->length : out->capacity);
}

/* The number under `key` of the settings. The host has checked them against the schema and filled in defaults: they are one
 * flat JSON object, and the key is there. */
static double number(struct ConefieldStr settings, const char *key) {
    char text[1024], quoted[64];
    size_t n = settings.length < sizeof text - 1 ? settings.length : sizeof text - 1;
    memcpy(text, settings.data, n);
    text[n] = 0;
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    const char *at = strstr(text, quoted);
    return at == NULL ? 0.0 : strtod(at + strlen(quoted), NULL);
}
