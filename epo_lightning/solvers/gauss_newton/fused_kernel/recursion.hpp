// The bodies of three functions, after what they share. `recursion.py` explains them, joins them and fills in the values
// between dollar signs. Arrays in fast memory have rows of LD numbers.
    typedef $T$ T;
    constexpr int A = $A$, M = 2 * A, D = 3 * M, LD = D + 4, WIDE = 4 * A, ITEMS = $ITEMS$ * A;
    constexpr int FACTOR = M * D + M;
#if defined(__CUDA_ARCH__)
    // The first warp of a game works, and its other ones wait in EPO_END.
    constexpr int LANES = 32;
    const int lane = threadIdx.x, lanes = LANES;
    #define EPO_SYNC() __syncwarp()
    #define EPO_FAST(count) __shared__ alignas(16) T fast[count]; if (lane < LANES) {
    #define EPO_END() } if (WP_TILE_BLOCK_DIM > LANES) __syncthreads(); else __syncwarp();
#else
    constexpr int LANES = 1;  // at least: so many rows and columns may be those of one thread
    const int lane = $CPU_LANE$, lanes = WP_TILE_BLOCK_DIM;
    #define EPO_SYNC() WP_TILE_SYNC()
    #define EPO_FAST(count) T* const fast = work.data + scratch; {
    #define EPO_END() }
#endif
    (void)A, (void)LD, (void)WIDE, (void)ITEMS, (void)FACTOR, (void)LANES, (void)M, (void)D;

// ---- eliminate
#if defined(__CUDA_ARCH__)
    __shared__ int verdict;
#endif
    int positive = 1;
    EPO_FAST(5 * M * LD + 2 * ITEMS)
    T* const P = fast;           // [D, LD]: the value function of the next state, and in column D its gradient
    T* const W = P + D * LD;     // [M, LD]: H_cp, H_cz before the motion, and H_cc = dt W_cz + W_cc
    T* const G = W + M * LD;     // [M, LD]
    T* const items = G + M * LD; // [2, ITEMS]: of this step, and of the one after it or before it
    constexpr int COLUMNS = (D + LANES) / LANES;  // of a thread, at most
    constexpr bool EARLY = COLUMNS == 1;          // a thread has the registers to read its costs a step ahead
    T cost[COLUMNS][WIDE];
    auto read_costs = [&](int k, int t) {
        const int c = lane + t * lanes;
        const bool of_costs = c < 2 * M || c == D;
        const int row = c == D ? WIDE : 4 * ((c % M) / 2) + (c < M ? 0 : 2) + c % 2;
        const T* const costs = work.data + hessian + (k * (WIDE + 1) + row) * WIDE;
        #pragma unroll
        for (int q = 0; q < WIDE; ++q) cost[t][q] = of_costs ? costs[q] : T(0);
    };
    if (EARLY && end > 0) read_costs(end - 1, 0);
    for (int e = lane; e < ITEMS && end > 0; e += lanes) {
        items[((end - 1) & 1) * ITEMS + e] = work.data[control + (end - 1) * ITEMS + e];
    }
    EPO_SYNC();
    for (int k = end - 1; k >= 0; --k) {
        const T* const now = items + (k & 1) * ITEMS;
        const T* const later = items + ((k + 1) & 1) * ITEMS;
        #pragma unroll
        for (int t = 0; t < COLUMNS; ++t) {
            const int c = lane + t * lanes;
            if (c > D) continue;
            const bool of_costs = c < 2 * M || c == D;
            if (!EARLY) read_costs(k, t);
            T column[D];
            if (k == end - 1) {
                #pragma unroll
                for (int i = 0; i < D; ++i) column[i] = T(0);
            } else {
                T g[M];
                #pragma unroll
                for (int r = 0; r < M; ++r) g[r] = G[r * LD + c];
                #pragma unroll
                for (int i = 0; i < 2 * M; ++i) column[i] = of_costs ? P[i * LD + c] : T(0);
                #pragma unroll
                for (int r = 0; r < M; ++r) {
                    const T stiffness = later[($RATE_STIFFNESS$ + r % 2) * A + r / 2];
                    const T rate = later[($RATE$ + r % 2) * A + r / 2];
                    column[2 * M + r] = c == 2 * M + r ? stiffness : c == D ? -rate : T(0);
                }
                #pragma unroll
                for (int r = 0; r < M; ++r) {
                    #pragma unroll
                    for (int i = 0; i < D; ++i) column[i] -= G[r * LD + i] * g[r];
                }
            }
            #pragma unroll
            for (int a = 0; a < A; ++a) {
                column[2 * a] += cost[t][4 * a];
                column[2 * a + 1] += cost[t][4 * a + 1];
                column[M + 2 * a] += cost[t][4 * a + 2];
                column[M + 2 * a + 1] += cost[t][4 * a + 3];
            }
            #pragma unroll
            for (int r = 0; r < M; ++r) {
                const T pull = now[($PULL$ + r % 2) * A + r / 2];
                W[r * LD + c] = dt * column[M + r] + column[2 * M + r] + (c == D ? pull : T(0));
            }
            if (of_costs) {
                #pragma unroll
                for (int r = 0; r < M; ++r) {
                    const T* const motion = now + ($MOTION$ + 2 * (r % 2)) * A + r / 2;
                    P[r * LD + c] = column[r];
                    P[(M + r) * LD + c] =
                        column[M + r] + motion[0] * column[r - r % 2] + motion[A] * column[r - r % 2 + 1];
                }
            }
        }
        EPO_SYNC();
        if (EARLY && k > 0) read_costs(k - 1, 0);
#if defined(__CUDA_ARCH__)
        T ahead[(ITEMS + LANES - 1) / LANES];  // items of the step before, on their way while the next lines compute
        #pragma unroll
        for (int t = 0; t < (ITEMS + LANES - 1) / LANES; ++t) {
            const int e = lane + t * LANES;
            ahead[t] = k > 0 && e < ITEMS ? work.data[control + (k - 1) * ITEMS + e] : T(0);
        }
#endif
        T L[M * (M + 1) / 2];  // rows, with reciprocals on the diagonal
        #pragma unroll
        for (int r = 0; r < M; ++r) {
            #pragma unroll
            for (int s = 0; s <= r; ++s) {
                T entry = dt * W[r * LD + M + s] + W[r * LD + 2 * M + s];
                if (r == s) entry += now[($DAMPED_STIFFNESS$ + r % 2) * A + r / 2];
                #pragma unroll
                for (int q = 0; q < s; ++q) entry -= L[r * (r + 1) / 2 + q] * L[s * (s + 1) / 2 + q];
                if (r == s) {
                    if (!(entry > T(0))) positive = 0;
#if defined(__CUDA_ARCH__)
                    entry = rsqrt(entry);
#else
                    entry = T(1) / sqrt(entry);
#endif
                } else {
                    entry *= L[s * (s + 1) / 2 + s];
                }
                L[r * (r + 1) / 2 + s] = entry;
            }
        }
        T* const factor = factors.data + k * FACTOR;
        for (int c = lane; c <= D; c += lanes) {
            T h[M];
            T scale = T(1);
            if (c >= 2 * M && c < D) {
                scale = -now[($RATE_STIFFNESS$ + c % 2) * A + (c - 2 * M) / 2];
                factor[M * D + c - 2 * M] = -scale;
                #pragma unroll
                for (int r = 0; r < M; ++r) h[r] = c == 2 * M + r ? T(1) : T(0);
            } else {
                #pragma unroll
                for (int r = 0; r < M; ++r) h[r] = W[r * LD + c];
            }
            if (c >= M && c < 2 * M) {
                const int a = (c - M) / 2;
                const T* const motion = now + ($MOTION$ + 2 * (c % 2)) * A + a;
                const T z0 = motion[0], z1 = motion[A];
                const T coupling = c % 2 ? now[$COUPLING$ * A + a] : T(0);
                #pragma unroll
                for (int r = 0; r < M; ++r) {
                    h[r] += W[r * LD + 2 * a] * z0 + W[r * LD + 2 * a + 1] * z1;
                    if (r == 2 * a) h[r] += coupling;
                }
                #pragma unroll
                for (int i = 0; i < 2 * M; ++i) P[i * LD + c] += P[i * LD + 2 * a] * z0 + P[i * LD + 2 * a + 1] * z1;
            }
            if (c == D) {
                #pragma unroll
                for (int r = 0; r < M; ++r) work.data[linear + k * M + r] = h[r];
            }
            #pragma unroll
            for (int r = 0; r < M; ++r) {
                #pragma unroll
                for (int s = 0; s < r; ++s) h[r] -= L[r * (r + 1) / 2 + s] * h[s];
                h[r] *= L[r * (r + 1) / 2 + r];
                G[r * LD + c] = scale * h[r];
            }
            if (c < D) {  // the gains, and of the columns of c the inverse of H_cc
                #pragma unroll
                for (int r = M - 1; r >= 0; --r) {
                    #pragma unroll
                    for (int s = r + 1; s < M; ++s) h[r] -= L[s * (s + 1) / 2 + r] * h[s];
                    h[r] *= L[r * (r + 1) / 2 + r];
                    factor[r * D + c] = h[r];
                }
            }
        }
#if defined(__CUDA_ARCH__)
        #pragma unroll
        for (int t = 0; t < (ITEMS + LANES - 1) / LANES; ++t) {
            const int e = lane + t * LANES;
            if (e < ITEMS) items[((k + 1) & 1) * ITEMS + e] = ahead[t];
        }
#else
        for (int e = lane; k > 0 && e < ITEMS; e += lanes) {
            items[((k + 1) & 1) * ITEMS + e] = work.data[control + (k - 1) * ITEMS + e];
        }
#endif
        EPO_SYNC();
    }
#if defined(__CUDA_ARCH__)
    if (lane == 0) verdict = positive;
#endif
    EPO_END()
#if defined(__CUDA_ARCH__)
    positive = verdict;
    EPO_SYNC();
#endif
    return positive;

// ---- stream
    // What a step of the next two functions reads, in fast memory: the factor, the linear term [M] and the motions [4, A].
    // While a step is computed, the numbers of the one after the next are on their way.
    constexpr int STREAM = FACTOR + M + 4 * A, PARTS = (STREAM + LANES - 1) / LANES;
    T ahead[PARTS];
    auto request = [&](int k) {
        #pragma unroll
        for (int t = 0; t < PARTS; ++t) {
            const int e = lane + t * lanes;
            if (e < FACTOR) ahead[t] = factors.data[k * FACTOR + e];
            else if (e < FACTOR + M) ahead[t] = work.data[linear + k * M + e - FACTOR];
            else if (e < STREAM) ahead[t] = work.data[control + k * ITEMS + $MOTION$ * A + e - FACTOR - M];
        }
    };
    auto deliver = [&](T* buffers, int k) {
        #pragma unroll
        for (int t = 0; t < PARTS; ++t) {
            const int e = lane + t * lanes;
            if (e < STREAM) buffers[(k & 1) * STREAM + e] = ahead[t];
        }
    };

// ---- pull
    // Linear terms backwards in time: h becomes the gradient by the controls of a step, for another right-hand side.
    EPO_FAST(2 * D + M + 2 * STREAM)
    T* const q = fast + 2 * D;
    T* const buffers = q + M;
    if (end > 0) {
        request(end - 1);
        deliver(buffers, end - 1);
    }
    if (end > 1) request(end - 2);
    for (int j = lane; j < 2 * D; j += lanes) fast[j] = T(0);
    EPO_SYNC();
    for (int k = end - 1; k >= 0; --k) {
        const T* const y = fast + (k & 1) * D;
        T* const before = fast + ((k + 1) & 1) * D;
        const T* const factor = buffers + (k & 1) * STREAM;
        const T* const motions = factor + FACTOR + M;
        for (int r = lane; r < M; r += lanes) {
            q[r] = factor[FACTOR + r] + dt * y[M + r] + y[2 * M + r];
            work.data[linear + k * M + r] = q[r];
        }
        EPO_SYNC();
        for (int j = lane; j < D; j += lanes) {
            T sum = T(0);
            #pragma unroll
            for (int r = 0; r < M; ++r) sum += factor[r * D + j] * q[r];
            if (j < 2 * M) {
                T moved = y[j] - sum;
                if (j >= M) {
                    const int a = (j - M) / 2;
                    const T* const motion = motions + 2 * (j % 2) * A + a;
                    moved += motion[0] * y[2 * a] + motion[A] * y[2 * a + 1];
                }
                before[j] = moved;
            } else {
                before[j] = factor[M * D + j - 2 * M] * sum;
            }
        }
        if (k > 0) deliver(buffers, k - 1);
        if (k > 1) request(k - 2);
        EPO_SYNC();
    }
    EPO_END()

// ---- push
    // The changes of the controls, -(K x + H_cc^-1 (h - S c)) with the controls c of the step before, forward in time. They go
    // to [agents, K, 2] from `place` on, in the rows of the agents or in their own ones, 0 to n - 1.
    EPO_FAST(D + M + 2 * STREAM)
    T* const x = fast;
    T* const change = fast + D;
    T* const buffers = change + M;
    if (end > 0) {
        request(0);
        deliver(buffers, 0);
    }
    if (end > 1) request(1);
    for (int j = lane; j < D; j += lanes) x[j] = T(0);
    EPO_SYNC();
    for (int k = 0; k < end; ++k) {
        const T* const factor = buffers + (k & 1) * STREAM;
        for (int r = lane; r < M; r += lanes) {
            T moved = T(0), steered = T(0);
            #pragma unroll
            for (int c = 0; c < 2 * M; ++c) moved += factor[r * D + c] * x[c];
            #pragma unroll
            for (int c = 0; c < M; ++c) {
                steered += factor[r * D + 2 * M + c] * (factor[FACTOR + c] - factor[M * D + c] * x[2 * M + c]);
            }
            change[r] = -(moved + steered);
        }
        if (k + 1 < end) deliver(buffers, k + 1);
        if (k + 2 < end) request(k + 2);
        EPO_SYNC();
        for (int a = lane; a < A; a += lanes) {
            const T* const motion = factor + FACTOR + M + a;
            const T turned = x[M + 2 * a], faster = x[M + 2 * a + 1];
            x[2 * a] += motion[0] * turned + motion[2 * A] * faster;
            x[2 * a + 1] += motion[A] * turned + motion[3 * A] * faster;
            x[M + 2 * a] = turned + dt * change[2 * a];
            x[M + 2 * a + 1] = faster + dt * change[2 * a + 1];
            x[2 * M + 2 * a] = change[2 * a];
            x[2 * M + 2 * a + 1] = change[2 * a + 1];
            if (a < count) {
                T* const controls = to.data + place + 2 * ((own_rows ? a : rows.data[a]) * K + k);
                controls[1] = change[2 * a];
                controls[0] = change[2 * a + 1];
            }
        }
        EPO_SYNC();
    }
    EPO_END()
