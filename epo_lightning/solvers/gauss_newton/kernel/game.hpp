// The interface to Python: plain pointers and strides (in elements), so that no array is copied on the way in.
//
// `interface.py` repeats these structures, enumerations and constants; `layout.hpp` exports them, and loading compares the two.
#pragma once

#include <cstddef>
#include <cstdint>

/// Weighted own features, in the order in which weights and their gradients are passed.
enum Own { GOAL, LANE, VELREF, VEL, ACC, TURNR, JERK, TURNACC, STEER, VELB, ACCB, TURNRB, JERKB, TURNACCB, HEADING, ACCREF, TURNRREF, OWN_COUNT };

/// Weighted pair features, in the same order as in Python.
enum Pair { PROXIMITY, CLEARANCE, CIRCLES, HEADWAY, LONGITUDINAL, LATERAL, TIME_TO_CONFLICT, PAIR_COUNT };

/// Index of a control, as in the arrays of the caller.
enum Control { ACCELERATION, TURN_RATE };

/// Signals that can have bounds.
enum Bounded { BOUND_VEL, BOUND_ACC, BOUND_TURNR, BOUND_JERK, BOUND_TURNACC, BOUND_COUNT };

/// Outcome of a problem. COMPLETED: all steps were taken. DAMPED: some steps were possible only with more damping. STOPPED: a step
/// was not possible, and the iterate before it was kept.
enum Status { COMPLETED, DAMPED, STOPPED };

/// Entries of a residual that the caller gives: its value, and its derivatives by x, y, heading and speed after a step and by the
/// acceleration and the turn rate of the step.
enum Given { GIVEN_VALUE, GIVEN_X, GIVEN_Y, GIVEN_HEADING, GIVEN_SPEED, GIVEN_ACCELERATION, GIVEN_TURN_RATE, GIVEN_COUNT };

constexpr int GIVEN_CURVATURE = (GIVEN_COUNT - 1) * GIVEN_COUNT / 2;  // entries of a symmetric matrix of these derivatives

/// Entries of a residual of a pair that the caller gives: its value, and its derivatives by x, y, heading and speed of the first and of
/// the second agent.
enum GivenPair { GIVEN_PAIR_VALUE, GIVEN_PAIR_FIRST, GIVEN_PAIR_SECOND = GIVEN_PAIR_FIRST + 4, GIVEN_PAIR_COUNT = GIVEN_PAIR_SECOND + 4 };

constexpr int GIVEN_PAIR_CURVATURE = (GIVEN_PAIR_COUNT - 1) * GIVEN_PAIR_COUNT / 2;

constexpr int64_t kMostAgents = 64;         // contacts are a 64-bit mask per agent
constexpr double kWheelbase = 0.6;          // distance between the axles as a share of a vehicle's length
constexpr double kSlowestSteering = 1.0;    // [m/s]; at lower speeds, a steering angle is computed with this speed
constexpr int64_t kRetries = 4;             // number of times that a failed factorisation is repeated with more damping
constexpr double kLightDamping = 1e3;  // a step with more damping does not show that a minimum has been reached
constexpr double kLeastDamping = 1e-7, kMostDamping = 1e7;  // range of the adaptive damping
constexpr double kThreeFrom = 4.0, kFiveFrom = 8.0;  // lengths [m] from which vehicles have three and five circles
constexpr double kTimeGap = 1.0;            // [s], of headways
constexpr double kConflictTime = 3.0;       // [s] up to which conflicts count
constexpr double kSlow = 0.01;              // [m^2/s^2], added to the squared relative speed of conflicts
constexpr double kLeastSize = 1e-3;         // [m], the least size in a denominator
constexpr double kLeastRaisedDamping = 1e-3;  // repetition k adds 10^k times the damping, but at least 10^k times this

extern "C" {

/// B scenes with M modes each: B * M problems of N agents over K steps. A null pointer stands for an absent feature.
struct EpoGame {
    int64_t B, M, N, K;
    int64_t lines, points;     // reference lines R of an agent and their points Q
    int64_t pair_stride;       // pairs are evaluated at states pair_stride, 2 pair_stride, ...
    double dt;
    double bounds[BOUND_COUNT][2];
    const void* initial;       // [B, N, 4] x, y, heading, speed
    int64_t initial_b, initial_n;
    const uint8_t* present;    // [B, N]
    const void* size;          // [B, N, 2] length, width
    const void* own[OWN_COUNT];  // [B, M, N] each
    int64_t own_strides[OWN_COUNT][3];
    const void* pair[PAIR_COUNT];  // [B, M, P] each
    int64_t pair_strides[PAIR_COUNT][3];
    const void* margins[PAIR_COUNT];  // [B, M, P] each, for the pair features that take one
    int64_t margin_strides[PAIR_COUNT][3];
    const void* goals;         // [B, M, N, 2]
    int64_t goals_b, goals_m, goals_n, goals_x;
    const void* references;    // [B, N, R, Q, 2]
    const int64_t* reference;  // [B, M, N]
    const void* reference_speed;  // [B, N]
    const void* goal_headings;  // [B, M, N]
    int64_t goal_heading_strides[3];
    const void* reference_controls;  // [B, M, N, K, 2], contiguous
    const int64_t* ends;       // [B] numbers of steps of the games, or null if all games have K steps
    int64_t lane_slides;       // whether nearest points of reference lines move with the agents in Gauss-Newton steps
    const void* given;         // [B, M, N, K, R, GIVEN_COUNT] weighted residuals of features that the kernel does not know, or null
    int64_t given_count;       // R
    const void* given_pairs;   // [B, M, P, K / pair_stride, R', GIVEN_PAIR_COUNT] such residuals of pairs, or null; no agent is held then
    int64_t given_pair_count;  // R'
    // Sums of value times second derivatives of the given residuals of an agent and of a pair, entries below and on the diagonal of
    // symmetric matrices, row by row; null for steps without the Hessian.
    const void* given_curvature;       // [B, M, N, K, GIVEN_CURVATURE]
    const void* given_pair_curvature;  // [B, M, P, K / pair_stride, GIVEN_PAIR_CURVATURE]
};

/// Arguments and results of S steps from `start`, in which the controls of absent agents are zero. Every array of controls is
/// [B, M, N, K, 2]: acceleration, turn rate.
struct EpoRun {
    int64_t steps;
    double step_size;
    void* damping;             // [B, M], or [B, M, N]: infinite for agents that do not move; if adaptive, overwritten by the last one
    int64_t damping_problem, damping_agent;
    int64_t exact;             // whether steps use the Hessian; such steps have no adjoint
    int64_t adaptive;          // whether every problem accepts or rejects its steps and adapts its damping; nothing is recorded
    int64_t record;            // whether to keep factors and nearest points for the adjoint
    const void* start;
    void* iterates;            // [S + 1, ...], or one array that is overwritten where iterate_stride is 0; two if adaptive
    int64_t iterate_stride;
    void* directions;          // [S, ...] if record, else one array of scratch
    void* states;              // [B, M, N, K, 4]
    void* initial_energy;      // [B, M]
    void* energy;              // [B, M]; null if the result of the steps is not evaluated
    void* gradient_norm;       // [B, M]
    int64_t* status;           // [B, M] of type Status
};

/// Cotangents that the adjoint reads, and gradients that it writes. `controls` is the cotangent of u_S on entry and that of u_0 on
/// return; the derivative of feedback equilibria does not change it.
struct EpoGradients {
    void* controls;            // [B, M, N, K, 2]
    const void* iterates;      // [S + 1, B, M, N, K, 2] further cotangents of u_0 .. u_S, or null
    const void* states;        // [B, M, N, K, 4] or null
    void* own[OWN_COUNT];      // [B, M, N] each, zero on entry
    void* pair[PAIR_COUNT];    // [B, M, P] each, zero on entry
    void* margins[PAIR_COUNT];  // [B, M, P] each, zero on entry; null for fixed margins
    void* goals;               // [B, M, N, 2], zero on entry
    void* goal_headings;       // [B, M, N], zero on entry
    void* reference_controls;  // [B, M, N, K, 2], zero on entry
    void* adjoint;             // [B, M, N, K, 2] mu of a single step, zero on entry, for the derivative of given residuals; or null
};

/// S linear-quadratic games of N agents over K steps, and their equilibria, in double precision; see `solvers/feedback/lq_game.py`.
/// All arrays are contiguous.
struct EpoLQGames {
    int64_t games, N, K;
    double rho;
    const double *A, *B;           // [games, N, K, 4, 4], [games, N, K, 4, 2]
    const double* own_cost;        // [games, N, K, 4, 5]
    const double* pair_cost;       // [games, P, K, 8, 9]
    const double *effort, *push;   // [games, N, K, 2, 2], [games, N, K, 2]
    const uint8_t* free;           // [games, N, K]
    double *gains, *offsets;       // [games, K, 2 N, 4 N], [games, K, 2 N]
    uint8_t* unique;               // [games]
};

/// The cotangent that the adjoint reads, and the gradients that it writes.
struct EpoLQGradients {
    const double* controls;        // [games, K, 2 N]
    double *A, *B, *own_cost, *pair_cost, *effort, *push;  // as in EpoLQGames
};

/// Iterated LQ games of B * M driving games, in double precision, and the derivative of their solutions; see `solvers/feedback`. The
/// derivative reads controls and status as the iteration has left them, and does not change them.
struct EpoFeedback {
    int64_t iterations, remembered, trials;  // largest numbers of LQ games, of points of the acceleration, and of tried step lengths
    int64_t terms;                 // number of steps of GMRES
    double tolerance, rho;
    double largest_move, shortest;  // largest change of a state in one iteration; least step length
    double dependent;              // part of a column, relative to its norm, up to which it depends on others
    double* controls;              // [B, M, N, K, 2]; the solution overwrites the initial strategies
    int64_t* status;               // [B, M]: COMPLETED if the iteration has ended, DAMPED if not, STOPPED if it was not possible
};

/// Policies of games of N agents around given trajectories, and the trajectories that follow them.
struct EpoPolicies {
    int64_t games, N, K;
    double dt, beta;               // time step [s]; share of the velocity before a step in its displacement
    const double* start;           // [games, N, 4]
    const double *states, *controls;  // [games, N, K, 4], [games, N, K, 2]
    const double *gains, *offsets;  // as in EpoLQGames
    const double* length;          // [games] factor of the offsets
    double *visited, *chosen;      // [games, N, K, 4], [games, N, K, 2]
};
}

/// The functions of one level of instructions; float first.
struct EpoLevel {
    void* (*solve_float)(const EpoGame*, const EpoRun*, int64_t first, int64_t last);
    void* (*solve_double)(const EpoGame*, const EpoRun*, int64_t first, int64_t last);
    void (*differentiate_float)(const void* tape, const EpoGame*, const EpoRun*, const EpoGradients*);
    void (*differentiate_double)(const void* tape, const EpoGame*, const EpoRun*, const EpoGradients*);
    void (*release_float)(void* tape);
    void (*release_double)(void* tape);
    void (*lq_equilibria)(const EpoLQGames*, int64_t first, int64_t last);
    void (*lq_pull_back)(const EpoLQGames*, const EpoLQGradients*, int64_t first, int64_t last);
    void (*lq_follow)(const EpoPolicies*, int64_t first, int64_t last);
    void (*feedback)(const EpoGame*, const EpoFeedback*, int64_t first, int64_t last);
    void (*feedback_pull_back)(const EpoGame*, const EpoFeedback*, const EpoGradients*, int64_t first, int64_t last);
    int64_t lanes;
};
