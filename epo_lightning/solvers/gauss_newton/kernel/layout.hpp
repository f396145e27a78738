// Sizes, offsets and constants of the interface by name, for the comparison with their copies in `interface.py`.
#pragma once

#include "game.hpp"

extern "C" {

struct EpoLayoutEntry {
    const char* name;  // null at the end of the table
    double value;
};
}

#define EPO_FIELD(type, field) {#type "." #field, double(offsetof(type, field))}
#define EPO_SIZE(type) {"sizeof " #type, double(sizeof(type))}
#define EPO_CONSTANT(name) {#name, double(name)}

constexpr EpoLayoutEntry kLayout[] = {
    EPO_SIZE(EpoGame), EPO_SIZE(EpoRun), EPO_SIZE(EpoGradients), EPO_SIZE(EpoLQGames), EPO_SIZE(EpoLQGradients), EPO_SIZE(EpoPolicies),
    EPO_SIZE(EpoFeedback),
    EPO_FIELD(EpoGame, B), EPO_FIELD(EpoGame, M), EPO_FIELD(EpoGame, N), EPO_FIELD(EpoGame, K),
    EPO_FIELD(EpoGame, lines), EPO_FIELD(EpoGame, points), EPO_FIELD(EpoGame, pair_stride), EPO_FIELD(EpoGame, dt),
    EPO_FIELD(EpoGame, bounds), EPO_FIELD(EpoGame, initial), EPO_FIELD(EpoGame, initial_b), EPO_FIELD(EpoGame, initial_n),
    EPO_FIELD(EpoGame, present), EPO_FIELD(EpoGame, size), EPO_FIELD(EpoGame, own), EPO_FIELD(EpoGame, own_strides),
    EPO_FIELD(EpoGame, pair), EPO_FIELD(EpoGame, pair_strides), EPO_FIELD(EpoGame, margins), EPO_FIELD(EpoGame, margin_strides),
    EPO_FIELD(EpoGame, goals), EPO_FIELD(EpoGame, goals_b), EPO_FIELD(EpoGame, goals_m), EPO_FIELD(EpoGame, goals_n),
    EPO_FIELD(EpoGame, goals_x), EPO_FIELD(EpoGame, references), EPO_FIELD(EpoGame, reference),
    EPO_FIELD(EpoGame, reference_speed), EPO_FIELD(EpoGame, goal_headings), EPO_FIELD(EpoGame, goal_heading_strides),
    EPO_FIELD(EpoGame, reference_controls), EPO_FIELD(EpoGame, ends), EPO_FIELD(EpoGame, lane_slides), EPO_FIELD(EpoGame, given),
    EPO_FIELD(EpoGame, given_count), EPO_FIELD(EpoGame, given_pairs), EPO_FIELD(EpoGame, given_pair_count),
    EPO_FIELD(EpoGame, given_curvature), EPO_FIELD(EpoGame, given_pair_curvature),
    EPO_FIELD(EpoRun, steps), EPO_FIELD(EpoRun, step_size), EPO_FIELD(EpoRun, damping), EPO_FIELD(EpoRun, damping_problem),
    EPO_FIELD(EpoRun, damping_agent), EPO_FIELD(EpoRun, exact), EPO_FIELD(EpoRun, adaptive),
    EPO_FIELD(EpoRun, record), EPO_FIELD(EpoRun, start), EPO_FIELD(EpoRun, iterates),
    EPO_FIELD(EpoRun, iterate_stride), EPO_FIELD(EpoRun, directions), EPO_FIELD(EpoRun, states),
    EPO_FIELD(EpoRun, initial_energy), EPO_FIELD(EpoRun, energy), EPO_FIELD(EpoRun, gradient_norm), EPO_FIELD(EpoRun, status),
    EPO_FIELD(EpoGradients, controls), EPO_FIELD(EpoGradients, iterates), EPO_FIELD(EpoGradients, states),
    EPO_FIELD(EpoGradients, own), EPO_FIELD(EpoGradients, pair), EPO_FIELD(EpoGradients, margins),
    EPO_FIELD(EpoGradients, goals), EPO_FIELD(EpoGradients, goal_headings), EPO_FIELD(EpoGradients, reference_controls),
    EPO_FIELD(EpoGradients, adjoint),
    EPO_FIELD(EpoLQGames, games), EPO_FIELD(EpoLQGames, N), EPO_FIELD(EpoLQGames, K), EPO_FIELD(EpoLQGames, rho),
    EPO_FIELD(EpoLQGames, A), EPO_FIELD(EpoLQGames, B), EPO_FIELD(EpoLQGames, own_cost), EPO_FIELD(EpoLQGames, pair_cost),
    EPO_FIELD(EpoLQGames, effort), EPO_FIELD(EpoLQGames, push), EPO_FIELD(EpoLQGames, free), EPO_FIELD(EpoLQGames, gains),
    EPO_FIELD(EpoLQGames, offsets), EPO_FIELD(EpoLQGames, unique), EPO_FIELD(EpoLQGradients, controls),
    EPO_FIELD(EpoLQGradients, A), EPO_FIELD(EpoLQGradients, B), EPO_FIELD(EpoLQGradients, own_cost),
    EPO_FIELD(EpoLQGradients, pair_cost), EPO_FIELD(EpoLQGradients, effort), EPO_FIELD(EpoLQGradients, push),
    EPO_FIELD(EpoPolicies, games), EPO_FIELD(EpoPolicies, N), EPO_FIELD(EpoPolicies, K), EPO_FIELD(EpoPolicies, dt),
    EPO_FIELD(EpoPolicies, beta), EPO_FIELD(EpoPolicies, start), EPO_FIELD(EpoPolicies, states),
    EPO_FIELD(EpoPolicies, controls), EPO_FIELD(EpoPolicies, gains), EPO_FIELD(EpoPolicies, offsets),
    EPO_FIELD(EpoPolicies, length), EPO_FIELD(EpoPolicies, visited), EPO_FIELD(EpoPolicies, chosen),
    EPO_FIELD(EpoFeedback, iterations), EPO_FIELD(EpoFeedback, remembered), EPO_FIELD(EpoFeedback, trials),
    EPO_FIELD(EpoFeedback, terms), EPO_FIELD(EpoFeedback, tolerance), EPO_FIELD(EpoFeedback, rho),
    EPO_FIELD(EpoFeedback, largest_move), EPO_FIELD(EpoFeedback, shortest), EPO_FIELD(EpoFeedback, dependent),
    EPO_FIELD(EpoFeedback, controls), EPO_FIELD(EpoFeedback, status),
    EPO_CONSTANT(GOAL), EPO_CONSTANT(LANE), EPO_CONSTANT(VELREF), EPO_CONSTANT(VEL), EPO_CONSTANT(ACC), EPO_CONSTANT(TURNR),
    EPO_CONSTANT(JERK), EPO_CONSTANT(TURNACC), EPO_CONSTANT(STEER), EPO_CONSTANT(VELB), EPO_CONSTANT(ACCB),
    EPO_CONSTANT(TURNRB), EPO_CONSTANT(JERKB), EPO_CONSTANT(TURNACCB), EPO_CONSTANT(HEADING), EPO_CONSTANT(ACCREF), EPO_CONSTANT(TURNRREF),
    EPO_CONSTANT(OWN_COUNT), EPO_CONSTANT(GIVEN_COUNT), EPO_CONSTANT(GIVEN_PAIR_COUNT),
    EPO_CONSTANT(PROXIMITY), EPO_CONSTANT(CLEARANCE), EPO_CONSTANT(PAIR_COUNT),
    EPO_CONSTANT(CIRCLES), EPO_CONSTANT(HEADWAY), EPO_CONSTANT(LONGITUDINAL), EPO_CONSTANT(LATERAL), EPO_CONSTANT(TIME_TO_CONFLICT),
    EPO_CONSTANT(kThreeFrom), EPO_CONSTANT(kFiveFrom), EPO_CONSTANT(kTimeGap), EPO_CONSTANT(kConflictTime), EPO_CONSTANT(kSlow),
    EPO_CONSTANT(kLeastSize),
    EPO_CONSTANT(BOUND_VEL), EPO_CONSTANT(BOUND_ACC), EPO_CONSTANT(BOUND_TURNR), EPO_CONSTANT(BOUND_JERK),
    EPO_CONSTANT(BOUND_TURNACC), EPO_CONSTANT(BOUND_COUNT),
    EPO_CONSTANT(COMPLETED), EPO_CONSTANT(DAMPED), EPO_CONSTANT(STOPPED),
    EPO_CONSTANT(kMostAgents), EPO_CONSTANT(kWheelbase), EPO_CONSTANT(kSlowestSteering), EPO_CONSTANT(kRetries),
    EPO_CONSTANT(kLeastRaisedDamping), EPO_CONSTANT(kLeastDamping), EPO_CONSTANT(kMostDamping),
    {nullptr, 0.0},
};
