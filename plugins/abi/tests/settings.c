/* Lists and numbers in settings. */
#include "conefield_helpers.h"
#include <assert.h>
static size_t of(const char *t, const char *k, double *o, size_t m) { struct ConefieldStr s = {(const uint8_t *)t, strlen(t)}; return numbers(s, k, o, m); }
int main(void) {
    double o[3] = {0, 0, 0};
    const char *t = "{\"a\":1.5,\"b\":[2,3.25,-4e1,5],\"c\":[],\"d\":7,\"e\":8}";
    assert(of(t, "a", o, 3) == 1 && o[0] == 1.5);
    assert(of(t, "b", o, 3) == 4 && o[0] == 2 && o[1] == 3.25 && o[2] == -40);
    assert(of(t, "c", o, 3) == 0 && of(t, "x", o, 3) == 0);
    assert(of(t, "d", o, 3) == 1 && o[0] == 7 && of(t, "e", o, 1) == 1 && o[0] == 8);
    assert(of("{ \"b\": [ 1 , 2 ] }", "b", o, 3) == 2);
    return 0;
}
