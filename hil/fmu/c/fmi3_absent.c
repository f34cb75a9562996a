/* What FMI 3.0 names and this FMU does not have: other kinds of simulation, clocks, arrays of bytes. Each answers with an
 * error, whatever it is given; so they are declared without their arguments, and fmi3Functions.h is not read here.
 */
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

int fmu_refuse(void *instance, const char *format, ...);

#define NO(NAME) \
    EXPORT int NAME(void *instance) { return fmu_refuse(instance, "%s: this FMU has nothing for it", #NAME); }
#define NONE(NAME) \
    EXPORT void *NAME(void) { return 0; }

NONE(fmi3InstantiateModelExchange)
NONE(fmi3InstantiateScheduledExecution)
NO(fmi3EnterEventMode) NO(fmi3EnterConfigurationMode) NO(fmi3ExitConfigurationMode) NO(fmi3EnterStepMode)
NO(fmi3GetFloat32) NO(fmi3GetInt8) NO(fmi3GetUInt8) NO(fmi3GetInt16) NO(fmi3GetUInt16) NO(fmi3GetUInt32)
NO(fmi3GetInt64) NO(fmi3GetUInt64) NO(fmi3GetString) NO(fmi3GetBinary) NO(fmi3GetClock)
NO(fmi3SetFloat32) NO(fmi3SetInt8) NO(fmi3SetUInt8) NO(fmi3SetInt16) NO(fmi3SetUInt16) NO(fmi3SetUInt32)
NO(fmi3SetInt64) NO(fmi3SetUInt64) NO(fmi3SetString) NO(fmi3SetBinary) NO(fmi3SetClock)
NO(fmi3GetNumberOfVariableDependencies) NO(fmi3GetVariableDependencies)
NO(fmi3GetDirectionalDerivative) NO(fmi3GetAdjointDerivative) NO(fmi3GetOutputDerivatives)
NO(fmi3GetIntervalDecimal) NO(fmi3GetIntervalFraction) NO(fmi3GetShiftDecimal) NO(fmi3GetShiftFraction)
NO(fmi3SetIntervalDecimal) NO(fmi3SetIntervalFraction) NO(fmi3SetShiftDecimal) NO(fmi3SetShiftFraction)
NO(fmi3EvaluateDiscreteStates) NO(fmi3UpdateDiscreteStates) NO(fmi3EnterContinuousTimeMode)
NO(fmi3CompletedIntegratorStep) NO(fmi3SetTime) NO(fmi3SetContinuousStates) NO(fmi3GetContinuousStateDerivatives)
NO(fmi3GetEventIndicators) NO(fmi3GetContinuousStates) NO(fmi3GetNominalsOfContinuousStates)
NO(fmi3GetNumberOfEventIndicators) NO(fmi3GetNumberOfContinuousStates) NO(fmi3ActivateModelPartition)
