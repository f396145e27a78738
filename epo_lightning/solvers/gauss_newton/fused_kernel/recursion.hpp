// The bodies of five functions, after what they share. `recursion.py` explains them, joins them and fills in the values
// between dollar signs. Arrays in fast memory have rows of LD numbers.
    typedef $T$ T;
    struct alignas(2 * sizeof(T)) Two { T at[2]; };
    struct alignas(4 * sizeof(T)) Four { T at[4]; };
    constexpr int A = $A$, M = 2 * A, D = 3 * M, LD = D + 4, WIDE = 4 * A, ITEMS = $ITEMS$ * A;
    constexpr int FACTOR = M * D + M + WIDE;  // gains [M, D], second derivatives by changes of controls [M], motions [4, A]
    constexpr int RING = $STEPS$ + 1;
    constexpr int WIDTH = 8 * A, GRADIENT = 6;  // see G below
    constexpr bool KEPT = $FACTORS$ >= 0;  // factors and linear terms are in fast memory too
#if defined(__CUDA_ARCH__)
    constexpr int LANES = 32, WARPS = WP_TILE_BLOCK_DIM / LANES, THREADS = WP_TILE_BLOCK_DIM;
    // Remainders of unsigned numbers are cheap, and numbers below 32 are known not to be negative.
    const int thread = threadIdx.x, threads = THREADS, lane = threadIdx.x % unsigned(LANES), lanes = LANES;
    const int warp = WARPS == 1 ? 0 : threadIdx.x / unsigned(LANES);
    #define EPO_SYNC() if (WARPS > 1) __syncthreads(); else __syncwarp()
    #define EPO_SYNC_LANES() __syncwarp()
    constexpr bool SHARED = $SHARED$;
#else
    constexpr int LANES = 1, WARPS = 1, THREADS = 1;  // a CPU may have more of them, and then less work for each
    const int thread = $CPU_LANE$, threads = WP_TILE_BLOCK_DIM, lane = thread, lanes = threads, warp = 0;
    #define EPO_SYNC() WP_TILE_SYNC()
    #define EPO_SYNC_LANES() WP_TILE_SYNC()
#endif
    (void)LD, (void)ITEMS, (void)FACTOR, (void)RING, (void)WIDTH, (void)GRADIENT, (void)KEPT;
    (void)threads, (void)thread, (void)lanes, (void)lane, (void)warp;

// ---- begin
    // After the last step there are no costs, and no controls whose changes cost anything.
    for (int e = thread; e < (D + M) * LD + M * WIDTH; e += threads) fast.data[e] = T(0);
    for (int e = thread; e < ITEMS; e += threads) fast.data[$CONTROL$ + end % RING * ITEMS + e] = T(0);
    EPO_SYNC();

// ---- slopes
    // Sums backwards in time, of forces by position, heading and speed, and of the squared derivatives by controls. Positions
    // move with the headings and speeds before, and the next change starts from a control.
    for (int i = thread; i < count; i += threads) {
        T* const sums = fast.data + 5 * i;
        T x = sums[0], y = sums[1], turned = sums[2], faster = sums[3], squared = sums[4];
        #pragma unroll 4
        for (int k = last - 1; k >= first; --k) {
            const T* const now = fast.data + $CONTROL$ + k % RING * ITEMS + i;
            const T* const later = fast.data + $CONTROL$ + (k + 1) % RING * ITEMS + i;
            const T* const motion = later + $MOTION$ * A;
            const Four force = ((const Four*)(fast.data + $OWN$))[((k - first) * A + i) * 5 + 4];
            turned += force.at[2] + motion[0] * x + motion[A] * y;
            faster += force.at[3] + motion[2 * A] * x + motion[3 * A] * y;
            x += force.at[0];
            y += force.at[1];
            const T turning = now[$PULL$ * A] - later[$RATE$ * A] + dt * turned;
            const T speeding = now[($PULL$ + 1) * A] - later[($RATE$ + 1) * A] + dt * faster;
            squared += turning * turning + speeding * speeding;
        }
        sums[0] = x, sums[1] = y, sums[2] = turned, sums[3] = faster, sums[4] = squared;
    }
    EPO_SYNC();

// ---- eliminate
    // The value function of the state after the last step is in fast memory if that step is not the last one of the game.
    T* const P = fast.data;      // [D, LD]: the value function of the next state, and in column D its gradient
    T* const W = P + D * LD;     // [M, LD]: H_cp, H_cz before the motion, and W_cc, with H_cc = dt W_cz + W_cc
    // [M, WIDTH]: the columns of an agent's p, z and c beside each other; the gradient has a place that is left.
    T* const G = W + M * LD;
    T* const verdict = P + D + 1;  // behind the columns of the first row
    const T* const controls = fast.data + $CONTROL$;  // [RING, ITEMS]
    const Four* const own = (const Four*)(fast.data + $OWN$);    // [STEPS, A, 5]
    const Four* const rows = (const Four*)(fast.data + $ROWS$);  // [pairs, STEPS, A, A]
    constexpr int COLUMNS = (D + LANES) / LANES, ROWS = (A + WARPS - 1) / WARPS;  // of a thread, at most
#if defined(__CUDA_ARCH__)
    auto root = [](T x) {  // 1 / sqrt(x): in single precision one instruction, with an error in the last digit
        if (sizeof(T) == 8) return T(rsqrt(x));
        const float given = x;
        float found;
        asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(found) : "f"(given));
        return T(found);
    };
#endif
    // Where a warp has all columns, it exchanges them: those of c hold H_cc = dt W_cz + W_cc itself, which is then read once.
    constexpr bool JOINED = LANES > D;
    const bool RECORDED = !KEPT || record;
    int positive = 1, place = last % RING;
    for (int k = last - 1; k >= first; --k) {
        const T* const later = controls + place * ITEMS;
        place = place == 0 ? RING - 1 : place - 1;
        const T* const now = controls + place * ITEMS;
        const Four* const owns = own + (k - first) * A * 5;
        #pragma unroll
        for (int column = 0; column < COLUMNS; ++column) {
            const int c = JOINED && lane > D ? D : lane + column * lanes;  // all threads take part in the exchange below
            if (c > D) break;
            const bool of_gradient = c == D, of_state = c < 2 * M;
            const int agent = c % M / 2, quantity = of_gradient ? 4 : c / M * 2 + c % 2;
            T *const Pc = P + c, *const Wc = W + c;
            const T* const Gc = G + (of_gradient ? GRADIENT : 8 * agent + quantity);
            T g[M];
            #pragma unroll
            for (int r = 0; r < M; ++r) g[r] = Gc[r * WIDTH];
            #pragma unroll
            for (int t = 0; t < ROWS; ++t) {
                const int a = WARPS == 1 ? t : warp + t * WARPS;
                if (a >= A) break;
                const bool alone = of_gradient || a == agent;
                T value[6] = {T(0), T(0), T(0), T(0), T(0), T(0)};
                if (of_gradient || of_state) {
                    const Four cost = owns[a * 5 + quantity];
                    #pragma unroll
                    for (int q = 0; q < 4; ++q) value[q] = Pc[(q / 2 * M + 2 * a + q % 2) * LD] + (alone ? cost.at[q] : T(0));
                    for (int f = 0; f < pairs; ++f) {
                        const Four* const step = rows + (f * $STEPS$ + k - first) * A * A;
                        const Four row = step[a * A + agent];
                        const T other = alone ? T(0) : step[agent * A + a].at[quantity];
                        #pragma unroll
                        for (int q = 0; q < 4; ++q) value[q] += alone ? T(0) : other * row.at[q];
                    }
                }
                #pragma unroll
                for (int q = 0; q < 2; ++q) {
                    const T stiffness = later[($RATE_STIFFNESS$ + q) * A + a], rate = later[($RATE$ + q) * A + a];
                    value[4 + q] = c == 2 * M + 2 * a + q ? stiffness : c == D ? now[($PULL$ + q) * A + a] - rate : T(0);
                }
                #pragma unroll
                for (int r = 0; r < M; ++r) {
                    const Four here = *(const Four*)(G + r * WIDTH + 8 * a);
                    #pragma unroll
                    for (int q = 0; q < 4; ++q) value[q] -= here.at[q] * g[r];
                    if (WARPS > 1 || r >= 2 * a) {  // the columns of c have zeros above the diagonal
                        const Two of_change = *(const Two*)(G + r * WIDTH + 8 * a + 4);
                        value[4] -= of_change.at[0] * g[r];
                        value[5] -= of_change.at[1] * g[r];
                    }
                }
                #pragma unroll
                for (int q = 0; q < 2; ++q) {
                    const T* const motion = now + ($MOTION$ + 2 * q) * A + a;
                    T by_control = dt * value[2 + q] + value[4 + q];
#if defined(__CUDA_ARCH__)
                    if (JOINED) {
                        const T of_state = __shfl_sync(~0u, by_control, lane - M);
                        by_control += c >= 2 * M && c < D ? dt * of_state : T(0);
                    }
#endif
                    if (lane + column * lanes > D) continue;
                    Wc[(2 * a + q) * LD] = by_control;
                    Pc[(2 * a + q) * LD] = value[q];
                    Pc[(M + 2 * a + q) * LD] = value[2 + q] + motion[0] * value[0] + motion[A] * value[1];
                }
            }
        }
        EPO_SYNC();
        T* const factor = factors.data + k * FACTOR;
        T* const kept = fast.data + $FACTORS$ + k * (FACTOR + M);  // if there is room
        if (WARPS < 4 || warp < 3) {
            T L[M][M];  // the lower triangle, with reciprocals on the diagonal
            #pragma unroll
            for (int r = 0; r < M; ++r) {
                #pragma unroll
                for (int s = 0; s <= r; s += 4) {
                    const Four by_change = *(const Four*)(W + r * LD + 2 * M + s);
                    Four by_state = {T(0), T(0), T(0), T(0)};
                    if (!JOINED) by_state = *(const Four*)(W + r * LD + M + s);
                    #pragma unroll
                    for (int q = 0; q < 4; ++q) {
                        if (s + q <= r) L[r][s + q] = dt * by_state.at[q] + by_change.at[q];
                    }
                }
                L[r][r] += now[($DAMPED_STIFFNESS$ + r % 2) * A + r / 2];
            }
            #pragma unroll
            for (int j = 0; j < M; ++j) {
                if (!(L[j][j] > T(0))) positive = 0;
#if defined(__CUDA_ARCH__)
                L[j][j] = root(L[j][j]);
#else
                L[j][j] = T(1) / sqrt(L[j][j]);
#endif
                #pragma unroll
                for (int r = j + 1; r < M; ++r) L[r][j] *= L[j][j];
                #pragma unroll
                for (int r = j + 1; r < M; ++r) {
                    #pragma unroll
                    for (int s = j + 1; s <= r; ++s) L[r][s] -= L[r][j] * L[s][j];
                }
            }
            // Of four warps, each of the first three has the columns of p, z or c.
            const int first = WARPS < 4 ? lane : lane < M ? warp * M + lane : lane == M && warp == 0 ? D : D + 1;
            for (int c = first; c <= D; c += WARPS < 4 ? lanes : D + 1) {
                T h[M];
                const bool of_change = c >= 2 * M && c < D, moving = c >= M && c < 2 * M;
                const int a = (c % M) / 2;
                const T *const Wc = W + c, *const Wp = W + 2 * a, *const motion = now + ($MOTION$ + 2 * (c % 2)) * A + a;
                T *const Gc = G + (c == D ? GRADIENT : 8 * a + c / M * 2 + c % 2), *const gain = factor + c;
                const T z0 = moving ? motion[0] : T(0), z1 = moving ? motion[A] : T(0);
                const T coupling = moving && c % 2 ? now[$COUPLING$ * A + a] : T(0);
                const T scale = of_change ? -now[($RATE_STIFFNESS$ + c % 2) * A + a] : T(1);
                #pragma unroll
                for (int r = 0; r < M; ++r) {
                    const Two of_position = *(const Two*)(Wp + r * LD);
                    h[r] = Wc[r * LD] + of_position.at[0] * z0 + of_position.at[1] * z1;
                    h[r] += r == 2 * a ? coupling : T(0);
                    h[r] = !of_change ? h[r] : c == 2 * M + r ? T(1) : T(0);
                }
                if (c == D) {
                    #pragma unroll
                    for (int r = 0; r < M; ++r) (KEPT ? kept[FACTOR + r] : work.data[linear + k * M + r]) = h[r];
                }
                #pragma unroll
                for (int r = 0; r < M; ++r) {
                    h[r] *= L[r][r];
                    #pragma unroll
                    for (int s = r + 1; s < M; ++s) h[s] -= L[s][r] * h[r];
                    Gc[r * WIDTH] = scale * h[r];
                }
                #pragma unroll
                for (int r = M - 1; r >= 0; --r) {
                    h[r] *= L[r][r];
                    #pragma unroll
                    for (int s = 0; s < r; ++s) h[s] -= L[r][s] * h[r];
                    // The gains, and of the columns of c the inverse of H_cc.
                    if (c < D && RECORDED) gain[r * D] = h[r];
                    if (c < D && KEPT) kept[r * D + c] = h[r];
                }
                if (of_change && RECORDED) factor[M * D + c - 2 * M] = -scale;
                if (of_change && KEPT) kept[M * D + c - 2 * M] = -scale;
            }
        }
        if (WARPS < 4 || warp >= 3) {  // H_pz and H_zz: motions act on the columns too
            constexpr int HELPERS = WARPS < 4 ? 0 : 3 * LANES;
            for (int e = thread - HELPERS; e < 2 * M * M; e += threads - HELPERS) {
                const int i = e / M, s = e % M, a = s / 2;
                const T* const motion = now + ($MOTION$ + 2 * (s % 2)) * A + a;
                P[i * LD + M + s] += P[i * LD + 2 * a] * motion[0] + P[i * LD + 2 * a + 1] * motion[A];
            }
            for (int e = thread - HELPERS; e < WIDE; e += threads - HELPERS) {
                if (RECORDED) factor[M * D + M + e] = now[$MOTION$ * A + e];
                if (KEPT) kept[M * D + M + e] = now[$MOTION$ * A + e];
            }
        }
        EPO_SYNC();
    }
    if (WARPS < 4) return positive;
    // The fourth warp has not seen the factors.
    if (thread == 0) verdict[0] = T(positive);
    EPO_SYNC();
    positive = verdict[0] > T(0);
    EPO_SYNC();
    return positive;

// ---- stream
    // What a step of the next two functions reads: the factor and the linear terms [M]. It is in fast memory if there is room
    // for all steps. Otherwise the numbers of the next three are on their way there while a step is computed. The first warp
    // of a game works, and its other ones wait.
    constexpr int STREAM = FACTOR + M, DEPTH = 4;
    constexpr int UNIT = 16 / sizeof(T);  // numbers that are copied at once
    constexpr int EACH = (D + LANES - 1) / LANES;  // numbers of a state of a thread, at most
    auto request = [&](T* buffers, int k) {
        const T* const factor = factors.data + k * FACTOR;
        const T* const others = work.data + linear + k * M - FACTOR;
        T* const to = buffers + (k % DEPTH) * STREAM;
        #pragma unroll 1
        for (int e = lane * UNIT; e < STREAM && k >= 0 && k < end; e += lanes * UNIT) {
            const T* const from = (e < FACTOR ? factor : others) + e;
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800  // copies that nothing waits for, from Ampere on
            if (SHARED) {
                const unsigned there = __cvta_generic_to_shared(to + e);
                asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(there), "l"(__cvta_generic_to_global(from)) : "memory");
                continue;
            }
#endif
            for (int q = 0; q < UNIT; ++q) to[e + q] = from[q];
        }
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
        asm volatile("cp.async.commit_group;" ::: "memory");
#endif
    };
    auto wait = [&]() {  // for the oldest of DEPTH - 1 requests
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
        asm volatile("cp.async.wait_group %0;" ::"n"(DEPTH - 2) : "memory");
#endif
        EPO_SYNC_LANES();
    };
    auto numbers_of = [&](T* buffers, int k) { return KEPT ? fast.data + $FACTORS$ + k * STREAM : buffers + (k % DEPTH) * STREAM; };

// ---- pull
    // Linear terms backwards in time: h becomes the gradient by the controls of a step, for another right-hand side.
    T* const states = fast.data;  // [2, D]: of a step and the one before it
    T* const slope = states + 2 * D;
    T* const buffers = slope + M;
    EPO_SYNC();
    if (KEPT) {  // fast memory holds the factors of another step, or none
        for (int e = 4 * thread; e < end * FACTOR; e += 4 * threads) {
            const int k = e / FACTOR;
            *(Four*)(numbers_of(buffers, k) + e - k * FACTOR) = *(const Four*)(factors.data + e);
        }
        for (int e = thread; e < end * M; e += threads) numbers_of(buffers, e / M)[FACTOR + e % M] = work.data[linear + e];
        EPO_SYNC();
    }
    if (warp == 0) {
        for (int back = 0; back < DEPTH - 1 && !KEPT; ++back) request(buffers, end - 1 - back);
        for (int j = lane; j < 2 * D; j += lanes) states[j] = T(0);
        for (int k = end - 1; k >= 0; --k) {
            if (KEPT) {
                EPO_SYNC_LANES();
            } else {
                wait();
            }
            const T* const y = states + (k & 1) * D;
            T* const before = states + ((k + 1) & 1) * D;
            T* const numbers = numbers_of(buffers, k);
            const T* const motions = numbers + M * D + M;
            T gain[EACH][M];  // read before the barrier, which nothing passes
            #pragma unroll
            for (int t = 0; t < EACH; ++t) {
                const int j = lane + t * lanes;
                #pragma unroll
                for (int r = 0; r < M; ++r) gain[t][r] = j < D ? numbers[r * D + j] : T(0);
            }
            for (int r = lane; r < M; r += lanes) {
                const T found = numbers[FACTOR + r] + dt * y[M + r] + y[2 * M + r];
                slope[r] = found;
                (KEPT ? numbers[FACTOR + r] : work.data[linear + k * M + r]) = found;
            }
            EPO_SYNC_LANES();
            if (!KEPT) request(buffers, k - DEPTH + 1);
            #pragma unroll
            for (int t = 0; t < EACH; ++t) {
                const int j = lane + t * lanes;
                if (j >= D) break;
                T sum = T(0);
                #pragma unroll
                for (int r = 0; r < M; ++r) sum += gain[t][r] * slope[r];
                if (j < 2 * M) {
                    T moved = y[j] - sum;
                    if (j >= M) {
                        const int a = (j - M) / 2;
                        const T* const motion = motions + 2 * (j % 2) * A + a;
                        moved += motion[0] * y[2 * a] + motion[A] * y[2 * a + 1];
                    }
                    before[j] = moved;
                } else {
                    before[j] = numbers[M * D + j - 2 * M] * sum;
                }
            }
        }
    }
    EPO_SYNC();

// ---- push
    // The changes of the controls, -(K x + H_cc^-1 (h - S c)) with the controls c of the step before, forward in time. They go
    // to [agents, K, 2] from `place` on, in the rows of the agents or in their own ones, 0 to n - 1.
    T* const known = fast.data;       // [2, D]: of a step and the next one: p, z and h - S c, with which gains are multiplied
    T* const shares = known + 2 * D;  // [3, M]: the products with each of them
    T* const buffers = shares + D;
    EPO_SYNC();
    if (warp == 0) {
        if (!KEPT) {
            for (int ahead = 0; ahead < DEPTH - 1; ++ahead) request(buffers, ahead);
            wait();
        }
        T state[EACH];
        T* target[EACH];  // of the changes of a control; none for p and z, and for agents that are absent
        #pragma unroll
        for (int t = 0; t < EACH; ++t) {
            const int j = lane + t * lanes, r = j % M, a = r / 2;
            state[t] = T(0);
            target[t] = nullptr;
            if (j >= 2 * M && j < D && a < count) target[t] = to.data + place + 2 * (own_rows ? a : rows.data[a]) * K + 1 - r % 2;
            if (j < D) known[j] = j < 2 * M ? T(0) : numbers_of(buffers, 0)[FACTOR + j - 2 * M];
        }
        for (int k = 0; k < end; ++k) {
            const T* const by = known + (k & 1) * D;
            T* const after = known + ((k + 1) & 1) * D;
            const T* const numbers = numbers_of(buffers, k);
            const T* const next = numbers_of(buffers, KEPT && k + 1 == end ? k : k + 1);  // not used after the last step
            // Read before the barrier, which nothing passes. (Written as j - j % M, the place is compiled to a wrong one by the
            // ptxas of CUDA 13.4.)
            Four gain[EACH][M / 4];
            #pragma unroll
            for (int t = 0; t < EACH; ++t) {
                const int j = lane + t * lanes, first = j / M * M, row = j < D ? (j - first) * D : 0;
                #pragma unroll
                for (int c = 0; c < M / 4; ++c) gain[t][c] = *(const Four*)(numbers + row + (j < D ? first : 0) + 4 * c);
            }
            EPO_SYNC_LANES();
            #pragma unroll
            for (int t = 0; t < EACH; ++t) {
                const int j = lane + t * lanes;
                if (j >= D) break;
                T share[4] = {T(0), T(0), T(0), T(0)};
                #pragma unroll
                for (int c = 0; c < M / 4; ++c) {
                    const Four with = *(const Four*)(by + j / M * M + 4 * c);
                    #pragma unroll
                    for (int q = 0; q < 4; ++q) share[q] += gain[t][c].at[q] * with.at[q];
                }
                shares[j] = (share[0] + share[1]) + (share[2] + share[3]);
            }
            if (KEPT) {
                EPO_SYNC_LANES();
            } else {
                request(buffers, k + DEPTH - 1);
                wait();
            }
            #pragma unroll
            for (int t = 0; t < EACH; ++t) {
                const int j = lane + t * lanes, r = j % M, a = r / 2;
                if (j >= D) break;
                const T* const motion = numbers + M * D + M + r % 2 * A + a;
                const T change = -(shares[r] + shares[M + r] + shares[2 * M + r]);
                const Two moving = *(const Two*)(by + M + 2 * a);
                const T moved = state[t] + motion[0] * moving.at[0] + motion[2 * A] * moving.at[1];
                const T use = next[FACTOR + r] - next[M * D + r] * change;
                state[t] = j < M ? moved : state[t] + dt * change;
                after[j] = j < 2 * M ? state[t] : use;
                if (target[t]) target[t][2 * k] = change;
            }
        }
    }
    EPO_SYNC();
