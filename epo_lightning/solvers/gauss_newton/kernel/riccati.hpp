// The damped Gauss-Newton step as a linear-quadratic problem, solved by one backward and one forward recursion over time.
//
// For n agents with m = 2n controls, the state holds the changes of positions p, of z = (heading, speed), and of the controls
// c of the step before, which rates couple with the present ones:
//
//     p+ = p + Z z,   z+ = z + dt c,   c+ = c,   Z = dt [v e', e] per agent,   e = (cos, sin), e' = (-sin, cos).
//
// The transition only adds rows and columns, so a step costs the elimination of its controls and little else:
//
//     L L' = H_cc,   G = L^-1 H_cx,   P = H_xx - G' G.
//
// P is the lower triangle of a [3m, 3m] array in the order (p, z, c). L [m, m] holds reciprocals on its diagonal. The last m
// columns of G [m, 3m] are lower triangular, because only a control's own rate couples it with the step before.
#pragma once

#include "lanes.hpp"

namespace EPO_LEVEL {

/// Number of agents: known at compile time where N > 0, else at run time.
template <int N>
struct Count {
    int dynamic;
    INLINE int agents() const { return N ? N : dynamic; }
    INLINE int controls() const { return 2 * agents(); }
};

/// Subtracts sum_k A[k][0..R) B[k][0..S) from C [R, S]; with FRESH, the old values of C count as zero. The sum is held in registers.
template <class T, int R, int S, bool FRESH = false>
INLINE void subtract_products(Vec<T>* C, int ldc, const Vec<T>* A, int astep, int arow, const Vec<T>* B, int bstep, int depth) {
    Vec<T> sum[R][S];
    for (int i = 0; i < R; ++i)
        for (int j = 0; j < S; ++j) sum[i][j] = FRESH ? Vec<T>{} : C[i * ldc + j];
    for (int k = 0; k < depth; ++k) {
        Vec<T> b[S];
        for (int j = 0; j < S; ++j) b[j] = B[k * bstep + j];
        for (int i = 0; i < R; ++i) {
            const Vec<T> a = A[k * astep + i * arow];
            for (int j = 0; j < S; ++j) sum[i][j] -= a * b[j];
        }
    }
    for (int i = 0; i < R; ++i)
        for (int j = 0; j < S; ++j) C[i * ldc + j] = sum[i][j];
}

/// Overwrites the lower triangle of H [m, m] with its Cholesky factor, whose diagonal entries are stored as reciprocals.
/// Sets the lanes of `positive` to false in which a pivot is not positive.
template <class T, int N>
INLINE void factorise(Count<N> count, Vec<T>* H, Mask<T>& positive) {
    const int m = count.controls();
    for (int j = 0; j < m; ++j) {
        Vec<T> pivot = H[j * m + j];
        for (int k = 0; k < j; ++k) pivot -= H[j * m + k] * H[j * m + k];
        positive &= pivot > 0;
        const Vec<T> inverse = T(1) / root<T>(pivot);
        H[j * m + j] = inverse;
        for (int i = j + 1; i < m; ++i) {
            Vec<T> entry = H[i * m + j];
            for (int k = 0; k < j; ++k) entry -= H[i * m + k] * H[j * m + k];
            H[i * m + j] = entry * inverse;
        }
    }
}

/// Overwrites X [m, S] with L^-1 X, two rows at a time; m is even.
template <class T, int N, int S>
INLINE void eliminate(Count<N> count, const Vec<T>* L, Vec<T>* X, int ldx) {
    const int m = count.controls();
    for (int r = 0; r < m; r += 2) {
        subtract_products<T, 2, S>(X + r * ldx, ldx, L + r * m, 1, m, X, ldx, r);
        for (int j = 0; j < S; ++j) {
            const Vec<T> first = X[r * ldx + j] * L[r * m + r];
            X[r * ldx + j] = first;
            X[(r + 1) * ldx + j] = (X[(r + 1) * ldx + j] - L[(r + 1) * m + r] * first) * L[(r + 1) * m + r + 1];
        }
    }
}

/// Entry (i, j) of a symmetric array that stores only its lower triangle.
template <class T>
INLINE Vec<T>& mirrored(Vec<T>* A, int lda, int i, int j) {
    return i >= j ? A[i * lda + j] : A[j * lda + i];
}

/// The nonzero entries of Z for one agent at one step: derivatives of its displacement (x, y) by its heading and by its speed.
template <class T>
struct Motion {
    Vec<T> x_heading, y_heading, x_speed, y_speed;
};

/// Writes H_cc to `H`. `P` is the cost-to-go of the next state, including that state's own costs; `curvature` [m] holds second
/// derivatives of the costs of the controls, which are added to the diagonal.
template <class T, int N>
INLINE void control_block(Count<N> count, Vec<T>* P, T dt, const Vec<T>* curvature, Vec<T>* H) {
    const int m = count.controls(), ld = 3 * m;
    for (int r = 0; r < m; ++r) {
        for (int s = 0; s <= r; ++s)
            H[r * m + s] = dt * (dt * P[(m + r) * ld + m + s] + P[(2 * m + r) * ld + m + s] + P[(2 * m + s) * ld + m + r]) +
                           P[(2 * m + r) * ld + 2 * m + s];
        H[r * m + r] += curvature[r];
    }
}

/// Replaces P by A' P A, where A is the transition to the next state, and writes H_cx to G. The rows of P that belong to the
/// controls are not computed here; `eliminate_controls` sets them. `coupling` [n] is the second derivative by an agent's turn rate
/// and its speed, and `rates` [m] the stiffness of the rates, which couples each control with that of the step before.
template <class T, int N>
INLINE void transition(
    Count<N> count, Vec<T>* P, T dt, const Motion<T>* Z, const Vec<T>* coupling, const Vec<T>* rates, Vec<T>* G) {
    const int n = count.agents(), m = count.controls(), ld = 3 * m;
    for (int r = 0; r < m; ++r) {
        Vec<T>* row = G + r * ld;
        for (int j = 0; j < m; ++j) row[j] = dt * P[(m + r) * ld + j] + P[(2 * m + r) * ld + j];
        for (int a = 0; a < n; ++a) {
            const Vec<T> by_x = row[2 * a], by_y = row[2 * a + 1];
            const int h = m + 2 * a, v = h + 1;
            row[h] = dt * mirrored<T>(P, ld, m + r, h) + P[(2 * m + r) * ld + h] + by_x * Z[a].x_heading + by_y * Z[a].y_heading;
            row[v] = dt * mirrored<T>(P, ld, m + r, v) + P[(2 * m + r) * ld + v] + by_x * Z[a].x_speed + by_y * Z[a].y_speed;
        }
        row[2 * m + r] = -rates[r];
        // Of the entries above the diagonal, only those in the diagonal blocks of 4 x 4 are read later; these must be zero.
        for (int j = r + 1; j % 4 != 0 && j < m; ++j) row[2 * m + j] = Vec<T>{};
    }
    for (int a = 0; a < n; ++a) G[2 * a * ld + m + 2 * a + 1] += coupling[a];
    // The rows z of P become H_zp = P_zp + Z' P_pp and H_zz = P_zz + Z' P_pz + H_zp Z. The term Z' P_pz needs the old P_zp, so it
    // is added first; then P_zp is replaced by H_zp, and H_zp Z is added.
    for (int a = 0; a < n; ++a) {
        Vec<T>* heading = P + (m + 2 * a) * ld;
        Vec<T>* speed = heading + ld;
        for (int b = 0; b <= a; ++b) {
            // Z' P_pz: the block of agents (a, b) needs the old entries of P_zp in the rows of agent b and the columns of agent a.
            const Vec<T>* heading_b = P + (m + 2 * b) * ld + 2 * a;
            const Vec<T>* speed_b = heading_b + ld;
            heading[m + 2 * b] += Z[a].x_heading * heading_b[0] + Z[a].y_heading * heading_b[1];
            speed[m + 2 * b] += Z[a].x_speed * heading_b[0] + Z[a].y_speed * heading_b[1];
            speed[m + 2 * b + 1] += Z[a].x_speed * speed_b[0] + Z[a].y_speed * speed_b[1];
            if (b < a) heading[m + 2 * b + 1] += Z[a].x_heading * speed_b[0] + Z[a].y_heading * speed_b[1];
        }
    }
    for (int a = 0; a < n; ++a) {
        Vec<T>* heading = P + (m + 2 * a) * ld;
        Vec<T>* speed = heading + ld;
        for (int j = 0; j < m; ++j) {
            const Vec<T> x = mirrored<T>(P, ld, 2 * a, j), y = mirrored<T>(P, ld, 2 * a + 1, j);
            heading[j] += Z[a].x_heading * x + Z[a].y_heading * y;
            speed[j] += Z[a].x_speed * x + Z[a].y_speed * y;
        }
        for (int b = 0; b <= a; ++b) {
            heading[m + 2 * b] += heading[2 * b] * Z[b].x_heading + heading[2 * b + 1] * Z[b].y_heading;
            speed[m + 2 * b] += speed[2 * b] * Z[b].x_heading + speed[2 * b + 1] * Z[b].y_heading;
            speed[m + 2 * b + 1] += speed[2 * b] * Z[b].x_speed + speed[2 * b + 1] * Z[b].y_speed;
            if (b < a) heading[m + 2 * b + 1] += heading[2 * b] * Z[b].x_speed + heading[2 * b + 1] * Z[b].y_speed;
        }
    }
}

/// Subtracts G' G from columns [from, from + S) of P, in the rows from the diagonal downwards. The controls' rows are overwritten
/// by -G' G, because their old values belong to the controls of the next step.
template <class T, int N, int S>
INLINE void subtract_square(Count<N> count, Vec<T>* P, const Vec<T>* G, int from) {
    const int m = count.controls(), ld = 3 * m;
    int i = from;
    for (; i < 2 * m; i += 4) subtract_products<T, 4, S>(P + i * ld + from, ld, G + i, ld, 1, G + from, ld, m);
    // G's last columns are lower triangular: rows above the diagonal are zero.
    for (; i + 4 <= ld; i += 4) {
        const Vec<T>* top = G + (i - 2 * m) * ld;
        subtract_products<T, 4, S, true>(P + i * ld + from, ld, top + i, ld, 1, top + from, ld, ld - i);
    }
    for (; i < ld; i += 2) {
        const Vec<T>* top = G + (i - 2 * m) * ld;
        subtract_products<T, 2, S, true>(P + i * ld + from, ld, top + i, ld, 1, top + from, ld, ld - i);
    }
}

/// Replaces G by L^-1 G, then P by P - G' G, and adds the stiffness `rates` [m] to the diagonal of the controls' part of P.
template <class T, int N>
INLINE void eliminate_controls(Count<N> count, const Vec<T>* L, const Vec<T>* rates, Vec<T>* G, Vec<T>* P) {
    const int m = count.controls(), ld = 3 * m;
    int j = 0;
    for (; j + 8 <= 2 * m; j += 8) eliminate<T, N, 8>(count, L, G + j, ld);
    for (; j + 4 <= 2 * m; j += 4) eliminate<T, N, 4>(count, L, G + j, ld);
    for (int c = 0; c < m; ++c) {
        Vec<T>* column = G + 2 * m + c;
        column[c * ld] *= L[c * m + c];
        for (int r = c + 1; r < m; ++r) {
            Vec<T> entry{};
            for (int k = c; k < r; ++k) entry -= L[r * m + k] * column[k * ld];
            column[r * ld] = entry * L[r * m + r];
        }
    }
    int from = 0;
    for (; from + 4 <= ld; from += 4) subtract_square<T, N, 4>(count, P, G, from);
    for (; from + 2 <= ld; from += 2) subtract_square<T, N, 2>(count, P, G, from);
    for (int c = 2 * m; c < ld; ++c) P[c * ld + c] += rates[c - 2 * m];
}

/// Takes the linear terms one step back in time. On entry `y` is the gradient of the cost-to-go by the next state, including that
/// state's own costs, and `h` the gradient of this step's costs by its controls. On return `y` belongs to the state of this step
/// (the caller adds the derivatives of this step's costs by the state), and `h` is L^-1 times the whole gradient by the controls,
/// which the forward recursion needs. In the first step (`first`) the state is given, so its `y` is not computed.
template <class T, int N>
INLINE void pull_linear(
    Count<N> count, const Vec<T>* L, const Vec<T>* G, T dt, const Motion<T>* Z, bool first, Vec<T>* y, Vec<T>* h) {
    const int n = count.agents(), m = count.controls(), ld = 3 * m;
    for (int r = 0; r < m; ++r) {
        Vec<T> entry = h[r] + dt * y[m + r] + y[2 * m + r];
        for (int k = 0; k < r; ++k) entry -= L[r * m + k] * h[k];
        h[r] = entry * L[r * m + r];
    }
    if (first) return;
    for (int a = 0; a < n; ++a) {
        y[m + 2 * a] += Z[a].x_heading * y[2 * a] + Z[a].y_heading * y[2 * a + 1];
        y[m + 2 * a + 1] += Z[a].x_speed * y[2 * a] + Z[a].y_speed * y[2 * a + 1];
    }
    for (int j = 2 * m; j < ld; ++j) y[j] = Vec<T>{};
    int j = 0;
    for (; j < 2 * m; j += 4) subtract_products<T, 1, 4>(y + j, 0, h, 1, 0, G + j, ld, m);
    for (; j < ld; ++j)
        for (int r = j - 2 * m; r < m; ++r) y[j] -= G[r * ld + j] * h[r];
}

/// Takes one step forward in time: writes the change of the controls, -L^-T (h + G x), to `c`, and replaces x by the next state.
template <class T, int N>
INLINE void push_state(
    Count<N> count, const Vec<T>* L, const Vec<T>* G, T dt, const Motion<T>* Z, bool first, const Vec<T>* h, Vec<T>* x, Vec<T>* c) {
    const int n = count.agents(), m = count.controls(), ld = 3 * m;
    for (int r = 0; r < m; ++r) {
        Vec<T> entry = h[r], other{};
        if (!first) {
            for (int j = 0; j < 2 * m; j += 2) {
                entry += G[r * ld + j] * x[j];
                other += G[r * ld + j + 1] * x[j + 1];
            }
            for (int j = 2 * m; j <= 2 * m + r; ++j) entry += G[r * ld + j] * x[j];
        }
        c[r] = -(entry + other);
    }
    for (int r = m - 1; r >= 0; --r) {
        Vec<T> entry = c[r];
        for (int k = r + 1; k < m; ++k) entry -= L[k * m + r] * c[k];
        c[r] = entry * L[r * m + r];
    }
    for (int a = 0; a < n; ++a) {
        const Vec<T> heading = x[m + 2 * a], speed = x[m + 2 * a + 1];
        x[2 * a] += Z[a].x_heading * heading + Z[a].x_speed * speed;
        x[2 * a + 1] += Z[a].y_heading * heading + Z[a].y_speed * speed;
    }
    for (int r = 0; r < m; ++r) {
        x[m + r] += dt * c[r];
        x[2 * m + r] = c[r];
    }
}

}  // namespace EPO_LEVEL
