// Of a triangle's three corners, and of faces that name them.
#pragma once

#include "native.h"

static inline float least3f(float a, float b, float c) {
    a = b < a ? b : a;
    return c < a ? c : a;
}
static inline float most3f(float a, float b, float c) {
    a = b > a ? b : a;
    return c > a ? c : a;
}
static inline double least3(double a, double b, double c) {
    a = b < a ? b : a;
    return c < a ? c : a;
}
static inline double most3(double a, double b, double c) {
    a = b > a ? b : a;
    return c > a ? c : a;
}
