// Arithmetic on W problems at once, one per lane of a vector register, and vector versions of a few library functions.
//
// No function here, or in the files that use it, mixes lanes: the result of a lane depends on that lane alone, bit by bit.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <utility>

#define INLINE inline __attribute__((always_inline))
#define NOINLINE __attribute__((noinline))
#define INLINE_LAMBDA __attribute__((always_inline))

namespace EPO_LEVEL {

#if defined(__AVX512F__)
constexpr int kRegister = 64;
#elif defined(__AVX__)
constexpr int kRegister = 32;
#else
constexpr int kRegister = 16;
#endif

template <class T>
struct Lanes;

template <>
struct Lanes<float> {
    static constexpr int W = kRegister / 4;
    typedef float V __attribute__((vector_size(kRegister)));
    typedef int32_t Mask __attribute__((vector_size(kRegister)));
    // Splits of pi/2 whose products with small integers are exact, and minimax polynomials (Cephes).
    static constexpr float kMagic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
    static constexpr float kFarthest = 1e5f;
    static constexpr float kPart[3] = {1.5703125f, 4.837512969970703125e-4f, 7.54978995489188216e-8f};
    static INLINE V sine(V x, V z) {
        return ((-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z * x + x;
    }
    static INLINE V cosine(V z) {
        return ((2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f) * z * z - 0.5f * z + 1.0f;
    }
    static constexpr float kLow = 0.41421356237309503f;
    static INLINE V arctangent(V x, V z) {
        return (((8.05374449538e-2f * z - 1.38776856032e-1f) * z + 1.99777106478e-1f) * z - 3.33329491539e-1f) * z * x + x;
    }
};

template <>
struct Lanes<double> {
    static constexpr int W = kRegister / 8;
    typedef double V __attribute__((vector_size(kRegister)));
    typedef int64_t Mask __attribute__((vector_size(kRegister)));
    static constexpr double kMagic = 6755399441055744.0;  // 1.5 * 2^52
    static constexpr double kFarthest = 1e9;
    static constexpr double kPart[3] = {1.57079632673412561417e+00, 6.07710050630396597660e-11, 2.02226624879595063154e-21};
    static INLINE V sine(V x, V z) {
        V p = 1.58969099521155010221e-10 * z - 2.50507602534068634195e-08;
        p = p * z + 2.75573137070700676789e-06;
        p = p * z - 1.98412698298579493134e-04;
        p = p * z + 8.33333333332248946124e-03;
        p = p * z - 1.66666666666666324348e-01;
        return p * z * x + x;
    }
    static INLINE V cosine(V z) {
        V p = -1.13596475577881948265e-11 * z + 2.08757232129817482790e-09;
        p = p * z - 2.75573143513906633035e-07;
        p = p * z + 2.48015872894767294178e-05;
        p = p * z - 1.38888888888741095749e-03;
        p = p * z + 4.16666666666666019037e-02;
        return p * z * z - 0.5 * z + 1.0;
    }
    static constexpr double kLow = 0.66;
    static INLINE V arctangent(V x, V z) {
        V p = -8.750608600031904122785e-1 * z - 1.615753718733365076637e1;
        p = p * z - 7.500855792314704667340e1;
        p = p * z - 1.228866684490136173410e2;
        p = p * z - 6.485021904942025371773e1;
        V q = z + 2.485846490142306297962e1;
        q = q * z + 1.650270098316988542046e2;
        q = q * z + 4.328810604912902668951e2;
        q = q * z + 4.853903996359136964868e2;
        q = q * z + 1.945506571482613964425e2;
        return x * (z * p / q) + x;
    }
};

template <class T>
using Vec = typename Lanes<T>::V;
template <class T>
using Mask = typename Lanes<T>::Mask;

template <class T>
INLINE Vec<T> splat(T value) {
    return Vec<T>{} + value;
}

template <class T>
INLINE Vec<T> least(Vec<T> a, Vec<T> b) {
    return a < b ? a : b;
}

template <class T>
INLINE Vec<T> most(Vec<T> a, Vec<T> b) {
    return a > b ? a : b;
}

template <class T>
INLINE bool any(Mask<T> mask) {
    decltype(mask[0] + 0) seen = 0;
    for (int lane = 0; lane < Lanes<T>::W; ++lane) seen |= mask[lane];
    return seen != 0;
}

/// Interleaves the first halves of two vectors, a0 b0 a1 b1 ..; with SECOND, their second halves.
template <class T, bool SECOND, std::size_t... I>
INLINE Vec<T> zip(Vec<T> a, Vec<T> b, std::index_sequence<I...>) {
    constexpr int W = Lanes<T>::W, from = SECOND ? W / 2 : 0;
#ifdef __clang__
    return __builtin_shufflevector(a, b, (from + int(I) / 2 + int(I) % 2 * W)...);
#else
    return __builtin_shuffle(a, b, Mask<T>{(from + int(I) / 2 + int(I) % 2 * W)...});
#endif
}

/// Transposes W vectors of W elements: exchanges v[i][j] and v[j][i]. Each of the log2(W) interleavings moves one bit of the index
/// i to the index j.
template <class T>
INLINE void transpose(Vec<T>* v) {
    constexpr int W = Lanes<T>::W;
    constexpr std::make_index_sequence<W> all{};
    for (int bit = 1; bit < W; bit *= 2) {
        Vec<T> shuffled[W];
        for (int i = 0; i < W / 2; ++i) {
            shuffled[2 * i] = zip<T, false>(v[i], v[i + W / 2], all);
            shuffled[2 * i + 1] = zip<T, true>(v[i], v[i + W / 2], all);
        }
        for (int i = 0; i < W; ++i) v[i] = shuffled[i];
    }
}

/// Reads W arrays of equal length, one for each lane, and calls put(e, v) with the vector v of their elements e.
template <class T, class Put>
INLINE void gather(const T* const* rows, int length, const Put& put) {
    constexpr int W = Lanes<T>::W;
    for (int next = 0; next < length; next += W) {
        const int start = length < W ? 0 : std::min(next, length - W);  // the last block overlaps the one before
        Vec<T> block[W];
        if (length < W) {
            for (int lane = 0; lane < W; ++lane)
                for (int e = 0; e < length; ++e) block[e][lane] = rows[lane][e];
        } else {
            for (int lane = 0; lane < W; ++lane) std::memcpy(&block[lane], rows[lane] + start, sizeof(Vec<T>));
            transpose<T>(block);
        }
        for (int e = 0; e < W && e < length; ++e) put(start + e, block[e]);
    }
}

/// Writes W arrays of equal length, one for each lane; get(e) returns the vector of their elements e. Arrays with a null address are
/// left out.
template <class T, class Get>
INLINE void scatter(const Get& get, int length, T* const* rows) {
    constexpr int W = Lanes<T>::W;
    for (int next = 0; next < length; next += W) {
        const int start = length < W ? 0 : std::min(next, length - W);  // the last block overlaps the one before
        Vec<T> block[W];
        for (int e = 0; e < W && e < length; ++e) block[e] = get(start + e);
        if (length >= W) transpose<T>(block);
        for (int lane = 0; lane < W; ++lane) {
            if (!rows[lane]) continue;
            if (length >= W)
                std::memcpy(rows[lane] + start, &block[lane], sizeof(Vec<T>));
            else
                for (int e = 0; e < length; ++e) rows[lane][e] = block[e][lane];
        }
    }
}

template <class T>
INLINE Vec<T> root(Vec<T> x) {
    Vec<T> result;
    for (int lane = 0; lane < Lanes<T>::W; ++lane) result[lane] = std::sqrt(x[lane]);
    return result;
}

/// Sine and cosine, to about one unit in the last place for angles of up to some thousand radians; NaN for angles that are
/// too large for the reduction.
template <class T>
INLINE void sincos(Vec<T> angle, Vec<T>& sine, Vec<T>& cosine) {
    using L = Lanes<T>;
    const Vec<T> quarters = (angle * T(0.63661977236758134308) + L::kMagic) - L::kMagic;
    const Vec<T> rest = ((angle - quarters * L::kPart[0]) - quarters * L::kPart[1]) - quarters * L::kPart[2];
    const Mask<T> quadrant = __builtin_convertvector(quarters, Mask<T>);
    const Vec<T> square = rest * rest;
    const Vec<T> s = L::sine(rest, square), c = L::cosine(square);
    const Mask<T> swapped = (quadrant & 1) != 0;
    const Vec<T> a = swapped ? c : s, b = swapped ? s : c;
    const Vec<T> doubt = angle < L::kFarthest && angle > -L::kFarthest ? Vec<T>{} : splat<T>(T(NAN));
    sine = ((quadrant & 2) != 0 ? -a : a) + doubt;
    cosine = (((quadrant + 1) & 2) != 0 ? -b : b) + doubt;
}

template <class T>
INLINE Vec<T> arctan(Vec<T> x) {
    using L = Lanes<T>;
    const Vec<T> one = splat<T>(1), size = x < 0 ? -x : x;
    const Mask<T> steep = size > T(2.41421356237309504880), middle = size > L::kLow;
    const Vec<T> offset = steep ? splat<T>(1.57079632679489661923) : (middle ? splat<T>(0.78539816339744830962) : Vec<T>{});
    const Vec<T> over = steep ? -one : (middle ? size - one : size);
    const Vec<T> under = steep ? size : (middle ? size + one : one);
    const Vec<T> reduced = over / under;
    const Vec<T> result = offset + L::arctangent(reduced, reduced * reduced);
    return x < 0 ? -result : result;
}

}  // namespace EPO_LEVEL
