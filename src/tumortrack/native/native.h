// What kernels are given: an array's address and sizes, as `tumortrack.native` packs them.
#pragma once

#define _GNU_SOURCE  // M_PI and the like

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define ARRAYS(name, type)                               \
    typedef struct { type *at; int64_t n[1]; } name##_1; \
    typedef struct { type *at; int64_t n[2]; } name##_2; \
    typedef struct { type *at; int64_t n[3]; } name##_3; \
    typedef struct { type *at; int64_t n[4]; } name##_4; \
    typedef struct { type *at; int64_t n[5]; } name##_5;

ARRAYS(f32, float)
ARRAYS(f64, double)
ARRAYS(i32, int32_t)
ARRAYS(i64, int64_t)
ARRAYS(u8, uint8_t)
ARRAYS(bool, bool)

typedef struct { double fx, fy, cx, cy; } Pinhole;  // a camera's, px

// A kernel gets what the struct of its name holds, whose size the caller compares with its own:
//     struct twice { f64_1 x; f64_1 out; };
//     KERNEL(void, twice) { for (int64_t n = 0; n < a->x.n[0]; n++) a->out.at[n] = 2 * a->x.at[n]; }
// It allocates nothing: what it needs is handed in.
#define VISIBLE __attribute__((visibility("default")))
#define KERNEL(result, name)                                    \
    VISIBLE const int64_t name##_bytes = sizeof(struct name);   \
    VISIBLE result name(const struct name *a);                  \
    result name(const struct name *a)

// For values that are no number the result is `low`, so that an index made of it is valid.
static inline float clampf(float x, float low, float high) {
    x = x > low ? x : low;
    return x < high ? x : high;
}
static inline double clampd(double x, double low, double high) {
    x = x > low ? x : low;
    return x < high ? x : high;
}
static inline int64_t min_i64(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t max_i64(int64_t a, int64_t b) { return a > b ? a : b; }
