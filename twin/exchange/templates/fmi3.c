/* FMI 3.0 for co-simulation over one component (component.h). */

#include "component.h"

#include "fmi3.h"

#define UNUSED(x) (void)(x)

typedef struct {
    struct Component component;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    int talks;
} Instance;

static fmi3Status failed(fmi3Instance instance, const char *said) {
    Instance *i = instance;
    if (i != NULL && i->log != NULL && i->talks) {
        i->log(i->environment, fmi3Error, "logStatusError", said);
    }
    return fmi3Error;
}

/* What is wrong, if anything, said. */
static fmi3Status done(fmi3Instance instance, const char *wrong) {
    return wrong == NULL ? fmi3OK : failed(instance, wrong);
}

API(const char *, fmi3GetVersion)(void) { return fmi3Version; }

API(fmi3Status, fmi3SetDebugLogging)(fmi3Instance instance, fmi3Boolean loggingOn,
                                     size_t nCategories, const fmi3String categories[]) {
    UNUSED(nCategories);
    UNUSED(categories);
    ((Instance *)instance)->talks = loggingOn;
    return fmi3OK;
}

/* --- instances --------------------------------------------------------------------------------- */

API(fmi3Instance, fmi3InstantiateCoSimulation)(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate) {
    const char *said = NULL;
    Instance *i;
    UNUSED(instanceName);
    UNUSED(resourcePath);
    UNUSED(visible);
    UNUSED(earlyReturnAllowed);
    UNUSED(requiredIntermediateVariables);
    UNUSED(nRequiredIntermediateVariables);
    UNUSED(intermediateUpdate);
    if (instantiationToken == NULL || strcmp(instantiationToken, TOKEN) != 0) {
        said = "the instantiation token is not this FMU's: binary and description do not fit";
    } else if (eventModeUsed) {
        said = "this FMU has no event mode";
    }
    i = said == NULL ? calloc(1, sizeof *i) : NULL;
    if (i == NULL) {
        if (logMessage != NULL && loggingOn) {
            logMessage(instanceEnvironment, fmi3Error, "logStatusError",
                       said != NULL ? said : "no memory");
        }
        return NULL;
    }
    i->environment = instanceEnvironment;
    i->log = logMessage;
    i->talks = loggingOn;
    component_reset(&i->component);
    return i;
}

API(fmi3Instance, fmi3InstantiateModelExchange)(fmi3String instanceName,
                                                fmi3String instantiationToken,
                                                fmi3String resourcePath, fmi3Boolean visible,
                                                fmi3Boolean loggingOn,
                                                fmi3InstanceEnvironment instanceEnvironment,
                                                fmi3LogMessageCallback logMessage) {
    UNUSED(instanceName);
    UNUSED(instantiationToken);
    UNUSED(resourcePath);
    UNUSED(visible);
    UNUSED(loggingOn);
    UNUSED(instanceEnvironment);
    UNUSED(logMessage);
    return NULL;
}

API(fmi3Instance, fmi3InstantiateScheduledExecution)(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
    fmi3LockPreemptionCallback lockPreemption, fmi3UnlockPreemptionCallback unlockPreemption) {
    UNUSED(clockUpdate);
    UNUSED(lockPreemption);
    UNUSED(unlockPreemption);
    return FULL_NAME(fmi3InstantiateModelExchange)(instanceName, instantiationToken, resourcePath,
                                                   visible, loggingOn, instanceEnvironment,
                                                   logMessage);
}

API(void, fmi3FreeInstance)(fmi3Instance instance) { free(instance); }

/* --- modes ------------------------------------------------------------------------------------- */

API(fmi3Status, fmi3EnterInitializationMode)(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                             fmi3Float64 tolerance, fmi3Float64 startTime,
                                             fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    struct Component *c = &((Instance *)instance)->component;
    UNUSED(toleranceDefined);
    UNUSED(tolerance);
    UNUSED(stopTimeDefined);
    UNUSED(stopTime);
    c->start = c->values[V_TIME] = startTime;
    c->mode = INITIALIZING;
    return fmi3OK;
}

API(fmi3Status, fmi3ExitInitializationMode)(fmi3Instance instance) {
    struct Component *c = &((Instance *)instance)->component;
    component_rest(c);
    c->mode = STEPPING;
    return fmi3OK;
}

API(fmi3Status, fmi3Terminate)(fmi3Instance instance) {
    ((Instance *)instance)->component.mode = TERMINATED;
    return fmi3OK;
}

API(fmi3Status, fmi3Reset)(fmi3Instance instance) {
    component_reset(&((Instance *)instance)->component);
    return fmi3OK;
}

/* --- values ------------------------------------------------------------------------------------ */

#define VALUES(NAME, TYPE, KIND)                                                                 \
    API(fmi3Status, fmi3Get##NAME)(fmi3Instance instance, const fmi3ValueReference references[], \
                                   size_t n, TYPE values[], size_t nValues) {                    \
        char said[200] = "as many values as value references are needed";                        \
        size_t j;                                                                                \
        double value = 0.0;                                                                      \
        for (j = 0; j < n && n == nValues; j++) {                                                \
            if (!component_get(&((Instance *)instance)->component, references[j], KIND, &value,  \
                               said, sizeof said)) {                                             \
                return failed(instance, said);                                                   \
            }                                                                                    \
            values[j] = (TYPE)value;                                                             \
        }                                                                                        \
        return n == nValues ? fmi3OK : failed(instance, said);                                   \
    }                                                                                            \
    API(fmi3Status, fmi3Set##NAME)(fmi3Instance instance, const fmi3ValueReference references[], \
                                   size_t n, const TYPE values[], size_t nValues) {              \
        char said[200] = "as many values as value references are needed";                        \
        size_t j;                                                                                \
        for (j = 0; j < n && n == nValues; j++) {                                                \
            if (!component_set(&((Instance *)instance)->component, references[j], KIND,          \
                               (double)values[j], said, sizeof said)) {                          \
                return failed(instance, said);                                                   \
            }                                                                                    \
        }                                                                                        \
        return n == nValues ? fmi3OK : failed(instance, said);                                   \
    }

VALUES(Float64, fmi3Float64, REAL)
VALUES(Boolean, fmi3Boolean, TRUTH)
VALUES(Int64, fmi3Int64, CHOICE)

#define NO_VALUES(NAME, TYPE)                                                                    \
    API(fmi3Status, fmi3Get##NAME)(fmi3Instance instance, const fmi3ValueReference references[], \
                                   size_t n, TYPE values[], size_t nValues) {                    \
        UNUSED(references);                                                                      \
        UNUSED(values);                                                                          \
        UNUSED(nValues);                                                                         \
        return n == 0 ? fmi3OK : failed(instance, "this FMU has no variable of type " #NAME);    \
    }                                                                                            \
    API(fmi3Status, fmi3Set##NAME)(fmi3Instance instance, const fmi3ValueReference references[], \
                                   size_t n, TYPE const values[], size_t nValues) {              \
        UNUSED(references);                                                                      \
        UNUSED(values);                                                                          \
        UNUSED(nValues);                                                                         \
        return n == 0 ? fmi3OK : failed(instance, "this FMU has no variable of type " #NAME);    \
    }

NO_VALUES(Float32, fmi3Float32)
NO_VALUES(Int8, fmi3Int8)
NO_VALUES(UInt8, fmi3UInt8)
NO_VALUES(Int16, fmi3Int16)
NO_VALUES(UInt16, fmi3UInt16)
NO_VALUES(Int32, fmi3Int32)
NO_VALUES(UInt32, fmi3UInt32)
NO_VALUES(UInt64, fmi3UInt64)
NO_VALUES(String, fmi3String)

API(fmi3Status, fmi3GetBinary)(fmi3Instance instance, const fmi3ValueReference references[],
                               size_t n, size_t sizes[], fmi3Binary values[], size_t nValues) {
    UNUSED(sizes);
    UNUSED(values);
    return FULL_NAME(fmi3GetUInt8)(instance, references, n, NULL, nValues);
}

API(fmi3Status, fmi3SetBinary)(fmi3Instance instance, const fmi3ValueReference references[],
                               size_t n, const size_t sizes[], const fmi3Binary values[],
                               size_t nValues) {
    UNUSED(sizes);
    UNUSED(values);
    return FULL_NAME(fmi3SetUInt8)(instance, references, n, NULL, nValues);
}

API(fmi3Status, fmi3GetClock)(fmi3Instance instance, const fmi3ValueReference references[],
                              size_t n, fmi3Clock values[]) {
    UNUSED(values);
    return FULL_NAME(fmi3GetUInt8)(instance, references, n, NULL, n);
}

API(fmi3Status, fmi3SetClock)(fmi3Instance instance, const fmi3ValueReference references[],
                              size_t n, const fmi3Clock values[]) {
    UNUSED(values);
    return FULL_NAME(fmi3SetUInt8)(instance, references, n, NULL, n);
}

/* --- time -------------------------------------------------------------------------------------- */

API(fmi3Status, fmi3DoStep)(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
                            fmi3Float64 communicationStepSize,
                            fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                            fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                            fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    struct Component *c = &((Instance *)instance)->component;
    const char *wrong;
    UNUSED(noSetFMUStatePriorToCurrentPoint);
    *eventHandlingNeeded = *terminateSimulation = *earlyReturn = fmi3False;
    *lastSuccessfulTime = currentCommunicationPoint;
    wrong = component_do_step(c, currentCommunicationPoint, communicationStepSize);
    if (wrong == NULL) {
        *lastSuccessfulTime += communicationStepSize;
        c->values[V_TIME] = *lastSuccessfulTime;
    }
    return done(instance, wrong);
}

/* --- states ------------------------------------------------------------------------------------ */

API(fmi3Status, fmi3GetFMUState)(fmi3Instance instance, fmi3FMUState *state) {
    return done(instance, component_save(&((Instance *)instance)->component, state));
}

API(fmi3Status, fmi3SetFMUState)(fmi3Instance instance, fmi3FMUState state) {
    ((Instance *)instance)->component = *(struct Component *)state;
    return fmi3OK;
}

API(fmi3Status, fmi3FreeFMUState)(fmi3Instance instance, fmi3FMUState *state) {
    UNUSED(instance);
    component_forget(state);
    return fmi3OK;
}

API(fmi3Status, fmi3SerializedFMUStateSize)(fmi3Instance instance, fmi3FMUState state,
                                            size_t *size) {
    UNUSED(instance);
    UNUSED(state);
    *size = sizeof(struct Component);
    return fmi3OK;
}

API(fmi3Status, fmi3SerializeFMUState)(fmi3Instance instance, fmi3FMUState state,
                                       fmi3Byte serialized[], size_t size) {
    return done(instance, component_serialize(state, serialized, size));
}

API(fmi3Status, fmi3DeserializeFMUState)(fmi3Instance instance, const fmi3Byte serialized[],
                                         size_t size, fmi3FMUState *state) {
    return done(instance, component_deserialize(serialized, size, state));
}

/* --- what this FMU has not --------------------------------------------------------------------- */

#define ABSENT "the description says that this FMU does not do this"

API(fmi3Status, fmi3EnterEventMode)(fmi3Instance instance) { return failed(instance, ABSENT); }
API(fmi3Status, fmi3EnterStepMode)(fmi3Instance instance) { return failed(instance, ABSENT); }
API(fmi3Status, fmi3EnterConfigurationMode)(fmi3Instance instance) {
    return failed(instance, ABSENT);
}
API(fmi3Status, fmi3ExitConfigurationMode)(fmi3Instance instance) {
    return failed(instance, ABSENT);
}
API(fmi3Status, fmi3EvaluateDiscreteStates)(fmi3Instance instance) {
    return failed(instance, ABSENT);
}
API(fmi3Status, fmi3EnterContinuousTimeMode)(fmi3Instance instance) {
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3GetNumberOfVariableDependencies)(fmi3Instance instance,
                                                     fmi3ValueReference reference,
                                                     size_t *nDependencies) {
    UNUSED(reference);
    UNUSED(nDependencies);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3GetVariableDependencies)(fmi3Instance instance, fmi3ValueReference dependent,
                                             size_t elementIndicesOfDependent[],
                                             fmi3ValueReference independents[],
                                             size_t elementIndicesOfIndependents[],
                                             fmi3DependencyKind dependencyKinds[],
                                             size_t nDependencies) {
    UNUSED(dependent);
    UNUSED(elementIndicesOfDependent);
    UNUSED(independents);
    UNUSED(elementIndicesOfIndependents);
    UNUSED(dependencyKinds);
    UNUSED(nDependencies);
    return failed(instance, ABSENT);
}

API(fmi3Status,
    fmi3GetDirectionalDerivative)(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                  size_t nUnknowns, const fmi3ValueReference knowns[],
                                  size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                  fmi3Float64 sensitivity[], size_t nSensitivity) {
    UNUSED(unknowns);
    UNUSED(nUnknowns);
    UNUSED(knowns);
    UNUSED(nKnowns);
    UNUSED(seed);
    UNUSED(nSeed);
    UNUSED(sensitivity);
    UNUSED(nSensitivity);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3GetAdjointDerivative)(fmi3Instance instance,
                                          const fmi3ValueReference unknowns[], size_t nUnknowns,
                                          const fmi3ValueReference knowns[], size_t nKnowns,
                                          const fmi3Float64 seed[], size_t nSeed,
                                          fmi3Float64 sensitivity[], size_t nSensitivity) {
    return FULL_NAME(fmi3GetDirectionalDerivative)(instance, unknowns, nUnknowns, knowns, nKnowns,
                                                   seed, nSeed, sensitivity, nSensitivity);
}

API(fmi3Status, fmi3GetOutputDerivatives)(fmi3Instance instance,
                                          const fmi3ValueReference references[], size_t n,
                                          const fmi3Int32 orders[], fmi3Float64 values[],
                                          size_t nValues) {
    UNUSED(references);
    UNUSED(n);
    UNUSED(orders);
    UNUSED(values);
    UNUSED(nValues);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3GetIntervalDecimal)(fmi3Instance instance,
                                        const fmi3ValueReference references[], size_t n,
                                        fmi3Float64 intervals[],
                                        fmi3IntervalQualifier qualifiers[]) {
    UNUSED(references);
    UNUSED(n);
    UNUSED(intervals);
    UNUSED(qualifiers);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3GetIntervalFraction)(fmi3Instance instance,
                                         const fmi3ValueReference references[], size_t n,
                                         fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                         fmi3IntervalQualifier qualifiers[]) {
    UNUSED(references);
    UNUSED(n);
    UNUSED(counters);
    UNUSED(resolutions);
    UNUSED(qualifiers);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3GetShiftDecimal)(fmi3Instance instance, const fmi3ValueReference references[],
                                     size_t n, fmi3Float64 shifts[]) {
    UNUSED(references);
    UNUSED(n);
    UNUSED(shifts);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3GetShiftFraction)(fmi3Instance instance,
                                      const fmi3ValueReference references[], size_t n,
                                      fmi3UInt64 counters[], fmi3UInt64 resolutions[]) {
    UNUSED(references);
    UNUSED(n);
    UNUSED(counters);
    UNUSED(resolutions);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3SetIntervalDecimal)(fmi3Instance instance,
                                        const fmi3ValueReference references[], size_t n,
                                        const fmi3Float64 intervals[]) {
    UNUSED(references);
    UNUSED(n);
    UNUSED(intervals);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3SetIntervalFraction)(fmi3Instance instance,
                                         const fmi3ValueReference references[], size_t n,
                                         const fmi3UInt64 counters[],
                                         const fmi3UInt64 resolutions[]) {
    UNUSED(references);
    UNUSED(n);
    UNUSED(counters);
    UNUSED(resolutions);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3SetShiftDecimal)(fmi3Instance instance, const fmi3ValueReference references[],
                                     size_t n, const fmi3Float64 shifts[]) {
    return FULL_NAME(fmi3SetIntervalDecimal)(instance, references, n, shifts);
}

API(fmi3Status,
    fmi3SetShiftFraction)(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                          const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) {
    return FULL_NAME(fmi3SetIntervalFraction)(instance, references, n, counters, resolutions);
}

API(fmi3Status,
    fmi3UpdateDiscreteStates)(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
                              fmi3Boolean *terminateSimulation,
                              fmi3Boolean *nominalsOfContinuousStatesChanged,
                              fmi3Boolean *valuesOfContinuousStatesChanged,
                              fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime) {
    UNUSED(discreteStatesNeedUpdate);
    UNUSED(terminateSimulation);
    UNUSED(nominalsOfContinuousStatesChanged);
    UNUSED(valuesOfContinuousStatesChanged);
    UNUSED(nextEventTimeDefined);
    UNUSED(nextEventTime);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3CompletedIntegratorStep)(fmi3Instance instance,
                                             fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                             fmi3Boolean *enterEventMode,
                                             fmi3Boolean *terminateSimulation) {
    UNUSED(noSetFMUStatePriorToCurrentPoint);
    UNUSED(enterEventMode);
    UNUSED(terminateSimulation);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3SetTime)(fmi3Instance instance, fmi3Float64 time) {
    UNUSED(time);
    return failed(instance, ABSENT);
}

API(fmi3Status, fmi3SetContinuousStates)(fmi3Instance instance, const fmi3Float64 values[],
                                         size_t n) {
    UNUSED(values);
    UNUSED(n);
    return failed(instance, ABSENT);
}

#define NO_NUMBERS(NAME)                                                                         \
    API(fmi3Status, fmi3Get##NAME)(fmi3Instance instance, fmi3Float64 values[], size_t n) {      \
        UNUSED(values);                                                                          \
        UNUSED(n);                                                                               \
        return failed(instance, ABSENT);                                                         \
    }

NO_NUMBERS(ContinuousStateDerivatives)
NO_NUMBERS(EventIndicators)
NO_NUMBERS(ContinuousStates)
NO_NUMBERS(NominalsOfContinuousStates)

API(fmi3Status, fmi3GetNumberOfEventIndicators)(fmi3Instance instance, size_t *n) {
    UNUSED(instance);
    *n = 0;
    return fmi3OK;
}

API(fmi3Status, fmi3GetNumberOfContinuousStates)(fmi3Instance instance, size_t *n) {
    return FULL_NAME(fmi3GetNumberOfEventIndicators)(instance, n);
}

API(fmi3Status, fmi3ActivateModelPartition)(fmi3Instance instance,
                                            fmi3ValueReference clockReference,
                                            fmi3Float64 activationTime) {
    UNUSED(clockReference);
    UNUSED(activationTime);
    return failed(instance, ABSENT);
}
