/* Decides at tiny, huge and undefined numbers: actions are inside their bounds, nothing is NaN. */
#include "filter.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double hostile[] = {
    0, 1, -1, 2.5, 1e-320, 1e-200, -1e-30, 1e6, -1e9, 1e30, -1e100, 1e154, 1e200, 1e300, NAN,
    INFINITY, -INFINITY};

static double drawn(int one_in)
{
    const int count = (int)(sizeof hostile / sizeof *hostile);
    return rand() % one_in ? 4.0 * rand() / RAND_MAX - 2.0 : hostile[rand() % count];
}

int main(void)
{
    safety_filter_input input;
    const int m = SAFETY_FILTER_INPUTS, count = (int)(sizeof input / sizeof(NUMBER));
    int failed = 0;
    for (int i = 0; i < 20000; i++) {
        NUMBER numbers[sizeof input / sizeof(NUMBER)];
        safety_filter_result result;
        safety_filter_defaults(&input);
        memcpy(numbers, &input, sizeof input);
        for (int j = 0; j < count - 2 * m; j++) {
            numbers[j] = (NUMBER)drawn(4);
        }
        for (int j = count - 2 * m; i % 4 == 0 && j < count; j++) {
            numbers[j] = (NUMBER)drawn(2);
        }
        memcpy(&input, numbers, sizeof input);
        const safety_filter_status status = safety_filter_decide(&input, &result);
        if (status == SAFETY_FILTER_INVALID_BOUNDS) {
            safety_filter_defaults(&input);
        }
        NUMBER action[SAFETY_FILTER_INPUTS], low[SAFETY_FILTER_INPUTS], high[SAFETY_FILTER_INPUTS];
        memcpy(action, &result.action, sizeof action);
        memcpy(low, &input.low, sizeof low);
        memcpy(high, &input.high, sizeof high);
        for (int j = 0; j < m; j++) {
            failed += !(isfinite(action[j]) && low[j] <= action[j] && action[j] <= high[j]);
        }
        for (int k = 0; status == SAFETY_FILTER_OK && k < SAFETY_FILTER_CONSTRAINTS; k++) {
            failed += isnan(result.barrier[k]) || isnan(result.margin[k]) || isnan(result.slack[k]);
        }
    }
    printf("%d failed\n", failed);
    return failed != 0;
}
