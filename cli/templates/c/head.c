#include "conefield_plugin.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TEXT(literal) { (const uint8_t *)(literal), sizeof(literal) - 1 }

/* Writes a readable line. */
static void say(struct ConefieldText *out, const char *line) {
    if (out == NULL) return;
    out->length = strlen(line);
    memcpy(out->data, line, out->length < out->capacity ? out->length : out->capacity);
}

/* The number under `key` of the settings: one flat JSON object, checked against the schema by the host, with defaults filled in.
 * For numbers only: settings that are texts, lists or tables need a JSON parser. NaN if the key is missing. */
static double number(struct ConefieldStr settings, const char *key) {
    char quoted[64];
    char *text = malloc(settings.length + 1);
    if (text == NULL) return NAN;
    memcpy(text, settings.data, settings.length);
    text[settings.length] = 0;
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    const char *at = strstr(text, quoted);
    double value = at == NULL ? NAN : strtod(at + strlen(quoted), NULL);
    free(text);
    return value;
}
