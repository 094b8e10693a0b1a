// Drags of an organ's vertices, one after the other. Fast math: the last digits (1e-5 mm) may
// depend on the processor, so that a scene replays bit for bit on the machine that made it, and
// elsewhere to that precision.
#include "native.h"

#define BLOCK 1024        // points whose coordinates stay in the L1 cache through all drags
#define SMALLEST (-12.0f) // exponents below, factors of 6e-6, count as zero
#define LOG2_E 1.4426950408889634f

// exp(x) for -80 < x <= 0. Unlike the C library's it is vectorized over points.
static inline float power_of_e(float x) {
    float binary = x * LOG2_E;
    int32_t exponent = (int32_t)(binary + 127.5f);  // as floats store it; positive: rounds down
    float r = binary - (float)(exponent - 127);
    // 2^r = sum of (r ln 2)^k / k!, within 1.2e-7 for r in -0.5 ... 0.5
    float power = 1.0f + r * (0.693147181f + r * (0.240226507f + r * (0.0555041087f
                + r * (0.00961812911f + r * (0.00133335581f + r * 0.000154035304f)))));
    exponent = exponent << 23;
    float whole;
    memcpy(&whole, &exponent, sizeof whole);
    return power * whole;
}

typedef struct { f32_2 centres, shifts; f32_1 sigmas; } Drags;

// The first k drags move n points, each by its shift, times a Gaussian of their distance from its
// centre. One machine code for both kernels, whose last digits are so the same.
static __attribute__((noinline)) void carry(
    const float *restrict points, int64_t n, const Drags *drags, int64_t k, float *restrict out
) {
    float x[BLOCK], y[BLOCK], z[BLOCK];
    for (int64_t start = 0; start < n; start += BLOCK, points += 3 * BLOCK, out += 3 * BLOCK) {
        int size = (int)min_i64(BLOCK, n - start);
        for (int i = 0; i < size; i++) {
            x[i] = points[3 * i];
            y[i] = points[3 * i + 1];
            z[i] = points[3 * i + 2];
        }
        for (int64_t d = 0; d < k; d++) {
            const float *centre = drags->centres.at + 3 * d, *shift = drags->shifts.at + 3 * d;
            float cx = centre[0], cy = centre[1], cz = centre[2];
            float sx = shift[0], sy = shift[1], sz = shift[2];
            float scale = -0.5f / (drags->sigmas.at[d] * drags->sigmas.at[d]);
            for (int i = 0; i < size; i++) {
                float dx = x[i] - cx, dy = y[i] - cy, dz = z[i] - cz;
                float exponent = scale * (dx * dx + dy * dy + dz * dz);
                float factor = power_of_e(exponent > SMALLEST ? exponent : SMALLEST);
                factor = exponent > SMALLEST ? factor : 0.0f;
                x[i] += factor * sx;
                y[i] += factor * sy;
                z[i] += factor * sz;
            }
        }
        for (int i = 0; i < size; i++) {
            out[3 * i] = x[i];
            out[3 * i + 1] = y[i];
            out[3 * i + 2] = z[i];
        }
    }
}

struct drag { f32_2 points; Drags drags; f32_2 out; };
KERNEL(void, drag) {
    carry(a->points.at, a->points.n[0], &a->drags, a->drags.sigmas.n[0], a->out.at);
}

struct drag_centres { f32_2 start; Drags drags; };
// The centres, made here of where they start: a vertex is dragged from where earlier drags left it.
KERNEL(void, drag_centres) {
    for (int64_t k = 0; k < a->start.n[0]; k++)
        carry(a->start.at + 3 * k, 1, &a->drags, k, a->drags.centres.at + 3 * k);
}
