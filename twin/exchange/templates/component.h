/* One ejector in an importing tool: its values, its model, and time.

   Everything is in struct Component, nothing is shared: there may be many. It is plain data, so that
   it can be copied, saved and restored as it is. The physics is in model.h. */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define ROW 1e-3   /* s, from one row of the model to the next, as the twin has them */
#define SLACK 1e-9 /* s, by which a time may be off */

enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED };

struct Component {
    double stamp; /* of the FMU that this belongs to */
    double mode;
    double changed; /* values that the model has not taken over yet */
    double start; /* s, when the simulation began */
    double rows;  /* whole ones since then */
    double since; /* s, into the present one */
    double asked; /* s, between the control's last two decisions */
    double values[VARIABLES]; /* by value reference */
    double k[PLANT_PREPARED]; /* coefficients, and what follows from them */
    double state[KERNEL_STATE];
    double control[CONTROL_CONTROL];
    double timer[CONTROL_TIMER];
};

static void component_reset(struct Component *c) {
    int n;
    memset(c, 0, sizeof *c);
    c->stamp = STAMP;
    for (n = 0; n < VARIABLES; n++) {
        c->values[n] = VARIABLE[n].start;
    }
    c->changed = 1.0;
}

/* Write what others read. ``drawn`` is the mean flow (kg/s) out of a vessel outside. */
static void component_outputs(struct Component *c, double drawn) {
    double *v = c->values, *s = c->state;
    double expected, signals;
    kernel_read_sensors(s, c->k, &expected, &signals);
    v[V_PORT_PRESSURE] = s[KERNEL_PORT];
    v[V_SENSOR_PRESSURE] = expected;
    v[V_SIGNAL_PART_PRESENT] = (to_whole(signals) & KERNEL_PART_PRESENT) != 0;
    v[V_SIGNAL_AIR_SAVING] = (to_whole(signals) & KERNEL_AIR_SAVING) != 0;
    v[V_SIGNAL_PHASE] = s[KERNEL_PHASE];
#if VESSEL_OUTSIDE
    v[V_VESSEL_MASS_FLOW] = drawn;
    v[V_LINE_TEMPERATURE] = s[KERNEL_LINE] * c->k[THETA_LINE_VOLUME]
        / (s[KERNEL_LINE_MASS] * PLANT_R);
#else
    (void)drawn;
    v[V_VESSEL_PRESSURE] = s[KERNEL_VESSEL];
    v[V_VESSEL_MASS_FLOW] = s[KERNEL_FAR];
#endif
}

/* Let a vessel outside stand as its port says. */
static void component_vessel(struct Component *c) {
#if VESSEL_OUTSIDE
    const double *v = c->values;
    double gas = c->k[THETA_VOLUME] / (PLANT_R * v[V_VESSEL_TEMPERATURE]);
    c->state[KERNEL_VESSEL] = v[V_VESSEL_PRESSURE];
    c->state[KERNEL_VESSEL_MASS] = v[V_VESSEL_PRESSURE] * gas;
#else
    (void)c;
#endif
}

/* Stand at ambient pressure, nothing commanded: as long as time does not run. */
static void component_rest(struct Component *c) {
    coefficients(c->values, c->k);
    plant_prepare_one(c->k);
    memset(c->state, 0, sizeof c->state);
    kernel_reset_to_ambient(c->state, c->k);
    memcpy(c->control, NOTHING_DONE, sizeof c->control);
    memset(c->timer, 0, sizeof c->timer);
    c->changed = 0.0;
    component_outputs(c, 0.0);
}

/* Go on under values that were set meanwhile. Coefficients before and after are compared without
   the mechanisms that change them. */
static void component_take_over(struct Component *c) {
    double before[PLANT_PREPARED];
    memcpy(before, c->k, sizeof before);
    kernel_remove_mechanisms(before);
    coefficients(c->values, c->k);
    plant_prepare_one(c->k);
    kernel_take_over(c->state, before, c->k);
    kernel_advance_mechanisms(c->state, c->k, 0.0);
    c->changed = 0.0;
}

/* One row of the model: the control decides, then ``dt`` seconds pass. Gives the gas (kg) that
   came out of a vessel outside. */
static double component_row(struct Component *c, double dt) {
    const double *v = c->values;
    double told, phase, before;
    int commands = 0;
    commands |= v[V_COMMAND_SUCTION] != 0.0 ? CONTROL_SUCTION : 0;
    commands |= v[V_COMMAND_BLOW_OFF] != 0.0 ? CONTROL_BLOW_OFF : 0;
    told = control_effective_command(c->timer, commands, c->asked, c->k[THETA_BLOW_OFF_MODE],
                        c->k[THETA_BLOW_OFF_TIME]);
    kernel_run_controls(c->state, c->control, &told, c->asked, c->k, &phase);
    component_vessel(c);
    before = c->state[KERNEL_VESSEL_MASS];
    kernel_step(c->state, c->k, dt, KERNEL_TOLERANCE);
    c->asked = dt;
    return before - c->state[KERNEL_VESSEL_MASS];
}

/* Advance to ``end`` (s) in the model's own rows; 0 if the model cannot. */
static int component_advance(struct Component *c, double end) {
    double gas = 0.0, begun = c->rows * ROW + c->since, passed;
    if (c->changed != 0.0) {
        component_take_over(c);
    }
    for (;;) {
        double left = end - c->start - (c->rows * ROW + c->since), dt = ROW - c->since;
        if (left < SLACK) {
            break;
        }
        if (left < dt - SLACK) {
            dt = left;
            c->since += dt;
        } else {
            c->rows += 1.0;
            c->since = 0.0;
        }
        gas += component_row(c, dt);
    }
    passed = c->rows * ROW + c->since - begun;
    component_outputs(c, passed > 0.0 ? gas / passed : 0.0);
    return isfinite(c->values[V_SENSOR_PRESSURE]) && isfinite(c->state[KERNEL_VESSEL_MASS]);
}

/* Advance from ``begin`` by ``step`` (s). Gives NULL, or what is wrong. */
static const char *component_do_step(struct Component *c, double begin, double step) {
    if (c->mode != STEPPING || !(step >= 0.0)) {
        return "a step needs a time ahead, after the initialization";
    }
    if (!component_advance(c, begin + step)) {
        return "the model has no number for this: look at inputs and parameters";
    }
    return NULL;
}

/* Set a value; 0, and what is wrong in ``said``, if it cannot be. */
static int component_set(struct Component *c, size_t reference, int kind, double value,
                         char *said, size_t room) {
    const struct Variable *one = reference < VARIABLES ? &VARIABLE[reference] : NULL;
    if (one == NULL || one->kind != kind) {
        snprintf(said, room, "no variable of this type has value reference %lu",
                 (unsigned long)reference);
        return 0;
    }
    if (one->settable == NEVER || (one->settable == BEFORE && c->mode >= STEPPING)) {
        snprintf(said, room, "%s cannot be set %s", one->name,
                 one->settable == NEVER ? "from outside" : "once time runs");
        return 0;
    }
    if (!(value >= one->low && value <= one->high)) {
        snprintf(said, room, "%s = %g is out of bounds: between %g and %g", one->name, value,
                 one->low, one->high);
        return 0;
    }
    if (c->values[reference] != value) {
        c->values[reference] = value;
        c->changed = 1.0;
    }
    return 1;
}

/* Read a value; 0, and what is wrong in ``said``, if there is none. */
static int component_get(struct Component *c, size_t reference, int kind, double *value,
                         char *said, size_t room) {
    if (reference >= VARIABLES || VARIABLE[reference].kind != kind) {
        snprintf(said, room, "no variable of this type has value reference %lu",
                 (unsigned long)reference);
        return 0;
    }
    if (c->changed != 0.0 && c->mode < STEPPING) {
        component_rest(c);
    }
    *value = c->values[reference];
    return 1;
}

/* --- saved components --------------------------------------------------------------------------- */

/* What can go wrong gives NULL, or what it is. */

static const char *component_save(const struct Component *c, void **saved) {
    if (*saved == NULL) {
        *saved = malloc(sizeof *c);
    }
    if (*saved == NULL) {
        return "no memory";
    }
    memcpy(*saved, c, sizeof *c);
    return NULL;
}

static void component_forget(void **saved) {
    if (saved != NULL) {
        free(*saved);
        *saved = NULL;
    }
}

static const char *component_serialize(const void *saved, void *bytes, size_t size) {
    if (size < sizeof(struct Component)) {
        return "more room is needed for the state";
    }
    memcpy(bytes, saved, sizeof(struct Component));
    return NULL;
}

static const char *component_deserialize(const void *bytes, size_t size, void **saved) {
    struct Component read;
    if (size == sizeof read) {
        memcpy(&read, bytes, size);
    }
    if (size != sizeof read || read.stamp != STAMP) {
        return "the state is not one of this FMU";
    }
    return component_save(&read, saved);
}
