/* FMI 2.0 for co-simulation over one component (component.h). */

#include "component.h"

#include "fmi2.h"

#define UNUSED(x) (void)(x)

typedef struct {
    struct Component component;
    const fmi2CallbackFunctions *callbacks;
    char *name;
    int talks;
} Instance;

/* No message has a % in it, so it is its own format: loggers that cannot take what follows one
   show it whole. */
static void say(const Instance *i, const char *said) {
    if (i->callbacks != NULL && i->callbacks->logger != NULL && i->talks) {
        i->callbacks->logger(i->callbacks->componentEnvironment, i->name, fmi2Error,
                             "logStatusError", said);
    }
}

static fmi2Status failed(fmi2Component instance, const char *said) {
    if (instance != NULL) {
        say(instance, said);
    }
    return fmi2Error;
}

/* What is wrong, if anything, said. */
static fmi2Status done(fmi2Component instance, const char *wrong) {
    return wrong == NULL ? fmi2OK : failed(instance, wrong);
}

API(const char *, fmi2GetTypesPlatform)(void) { return fmi2TypesPlatform; }

API(const char *, fmi2GetVersion)(void) { return fmi2Version; }

API(fmi2Status, fmi2SetDebugLogging)(fmi2Component instance, fmi2Boolean loggingOn,
                                     size_t nCategories, const fmi2String categories[]) {
    UNUSED(nCategories);
    UNUSED(categories);
    ((Instance *)instance)->talks = loggingOn;
    return fmi2OK;
}

/* --- instances --------------------------------------------------------------------------------- */

API(void, fmi2FreeInstance)(fmi2Component instance) {
    if (instance != NULL) {
        free(((Instance *)instance)->name);
        free(instance);
    }
}

API(fmi2Component, fmi2Instantiate)(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                                    fmi2String fmuResourceLocation,
                                    const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                                    fmi2Boolean loggingOn) {
    const char *said = NULL;
    size_t length = instanceName != NULL ? strlen(instanceName) + 1 : 1;
    Instance *i = calloc(1, sizeof *i);
    UNUSED(fmuResourceLocation);
    UNUSED(visible);
    if (i == NULL) {
        return NULL;
    }
    i->callbacks = functions;
    i->talks = loggingOn;
    i->name = calloc(length, 1);
    if (i->name == NULL) {
        said = "no memory";
    } else if (fmuGUID == NULL || strcmp(fmuGUID, TOKEN) != 0) {
        said = "the GUID is not this FMU's: binary and description do not fit";
    } else if (fmuType != fmi2CoSimulation) {
        said = "this FMU is for co-simulation";
    }
    if (i->name != NULL && instanceName != NULL) {
        memcpy(i->name, instanceName, length);
    }
    if (said != NULL) {
        say(i, said);
        FULL_NAME(fmi2FreeInstance)(i);
        return NULL;
    }
    component_reset(&i->component);
    return i;
}

/* --- modes ------------------------------------------------------------------------------------- */

API(fmi2Status, fmi2SetupExperiment)(fmi2Component instance, fmi2Boolean toleranceDefined,
                                     fmi2Real tolerance, fmi2Real startTime,
                                     fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    UNUSED(toleranceDefined);
    UNUSED(tolerance);
    UNUSED(stopTimeDefined);
    UNUSED(stopTime);
    ((Instance *)instance)->component.start = startTime;
    return fmi2OK;
}

API(fmi2Status, fmi2EnterInitializationMode)(fmi2Component instance) {
    ((Instance *)instance)->component.mode = INITIALIZING;
    return fmi2OK;
}

API(fmi2Status, fmi2ExitInitializationMode)(fmi2Component instance) {
    struct Component *c = &((Instance *)instance)->component;
    component_rest(c);
    c->mode = STEPPING;
    return fmi2OK;
}

API(fmi2Status, fmi2Terminate)(fmi2Component instance) {
    ((Instance *)instance)->component.mode = TERMINATED;
    return fmi2OK;
}

API(fmi2Status, fmi2Reset)(fmi2Component instance) {
    component_reset(&((Instance *)instance)->component);
    return fmi2OK;
}

/* --- values ------------------------------------------------------------------------------------ */

#define VALUES(NAME, TYPE, KIND)                                                                 \
    API(fmi2Status, fmi2Get##NAME)(fmi2Component instance,                                       \
                                   const fmi2ValueReference references[], size_t n,              \
                                   TYPE values[]) {                                              \
        char said[200];                                                                          \
        size_t j;                                                                                \
        double value = 0.0;                                                                      \
        for (j = 0; j < n; j++) {                                                                \
            if (!component_get(&((Instance *)instance)->component, references[j], KIND, &value,  \
                               said, sizeof said)) {                                             \
                return failed(instance, said);                                                   \
            }                                                                                    \
            values[j] = (TYPE)value;                                                             \
        }                                                                                        \
        return fmi2OK;                                                                           \
    }                                                                                            \
    API(fmi2Status, fmi2Set##NAME)(fmi2Component instance,                                       \
                                   const fmi2ValueReference references[], size_t n,              \
                                   const TYPE values[]) {                                        \
        char said[200];                                                                          \
        size_t j;                                                                                \
        for (j = 0; j < n; j++) {                                                                \
            if (!component_set(&((Instance *)instance)->component, references[j], KIND,          \
                               (double)values[j], said, sizeof said)) {                          \
                return failed(instance, said);                                                   \
            }                                                                                    \
        }                                                                                        \
        return fmi2OK;                                                                           \
    }

VALUES(Real, fmi2Real, REAL)
VALUES(Boolean, fmi2Boolean, TRUTH)
VALUES(Integer, fmi2Integer, CHOICE)

API(fmi2Status, fmi2GetString)(fmi2Component instance, const fmi2ValueReference references[],
                               size_t n, fmi2String values[]) {
    UNUSED(references);
    UNUSED(values);
    return n == 0 ? fmi2OK : failed(instance, "this FMU has no variable of type String");
}

API(fmi2Status, fmi2SetString)(fmi2Component instance, const fmi2ValueReference references[],
                               size_t n, const fmi2String values[]) {
    UNUSED(values);
    return FULL_NAME(fmi2GetString)(instance, references, n, NULL);
}

/* --- time -------------------------------------------------------------------------------------- */

API(fmi2Status, fmi2DoStep)(fmi2Component instance, fmi2Real currentCommunicationPoint,
                            fmi2Real communicationStepSize,
                            fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    struct Component *c = &((Instance *)instance)->component;
    UNUSED(noSetFMUStatePriorToCurrentPoint);
    return done(instance, component_do_step(c, currentCommunicationPoint, communicationStepSize));
}

API(fmi2Status, fmi2CancelStep)(fmi2Component instance) {
    return failed(instance, "a step is done when it returns: there is none to cancel");
}

/* --- states ------------------------------------------------------------------------------------ */

API(fmi2Status, fmi2GetFMUstate)(fmi2Component instance, fmi2FMUstate *state) {
    return done(instance, component_save(&((Instance *)instance)->component, state));
}

API(fmi2Status, fmi2SetFMUstate)(fmi2Component instance, fmi2FMUstate state) {
    ((Instance *)instance)->component = *(struct Component *)state;
    return fmi2OK;
}

API(fmi2Status, fmi2FreeFMUstate)(fmi2Component instance, fmi2FMUstate *state) {
    UNUSED(instance);
    component_forget(state);
    return fmi2OK;
}

API(fmi2Status, fmi2SerializedFMUstateSize)(fmi2Component instance, fmi2FMUstate state,
                                            size_t *size) {
    UNUSED(instance);
    UNUSED(state);
    *size = sizeof(struct Component);
    return fmi2OK;
}

API(fmi2Status, fmi2SerializeFMUstate)(fmi2Component instance, fmi2FMUstate state,
                                       fmi2Byte serialized[], size_t size) {
    return done(instance, component_serialize(state, serialized, size));
}

API(fmi2Status, fmi2DeSerializeFMUstate)(fmi2Component instance, const fmi2Byte serialized[],
                                         size_t size, fmi2FMUstate *state) {
    return done(instance, component_deserialize(serialized, size, state));
}

/* --- what this FMU has not --------------------------------------------------------------------- */

#define ABSENT "the description says that this FMU does not do this"

API(fmi2Status,
    fmi2GetDirectionalDerivative)(fmi2Component instance, const fmi2ValueReference unknowns[],
                                  size_t nUnknown, const fmi2ValueReference knowns[],
                                  size_t nKnown, const fmi2Real seed[], fmi2Real sensitivity[]) {
    UNUSED(unknowns);
    UNUSED(nUnknown);
    UNUSED(knowns);
    UNUSED(nKnown);
    UNUSED(seed);
    UNUSED(sensitivity);
    return failed(instance, ABSENT);
}

API(fmi2Status,
    fmi2SetRealInputDerivatives)(fmi2Component instance, const fmi2ValueReference references[],
                                 size_t n, const fmi2Integer orders[], const fmi2Real values[]) {
    UNUSED(references);
    UNUSED(n);
    UNUSED(orders);
    UNUSED(values);
    return failed(instance, ABSENT);
}

API(fmi2Status, fmi2GetRealOutputDerivatives)(fmi2Component instance,
                                              const fmi2ValueReference references[], size_t n,
                                              const fmi2Integer orders[], fmi2Real values[]) {
    UNUSED(values);
    return FULL_NAME(fmi2SetRealInputDerivatives)(instance, references, n, orders, NULL);
}

/* Steps are done when they return, so none is pending and none has a status of its own. */
#define NO_STATUS(NAME, TYPE)                                                                    \
    API(fmi2Status, fmi2Get##NAME)(fmi2Component instance, const fmi2StatusKind kind,            \
                                   TYPE *value) {                                                \
        UNUSED(instance);                                                                        \
        UNUSED(kind);                                                                            \
        UNUSED(value);                                                                           \
        return fmi2Discard;                                                                      \
    }

NO_STATUS(Status, fmi2Status)
NO_STATUS(RealStatus, fmi2Real)
NO_STATUS(IntegerStatus, fmi2Integer)
NO_STATUS(BooleanStatus, fmi2Boolean)
NO_STATUS(StringStatus, fmi2String)
