/* API(type, name) begins the definition of a function that importing tools call. A shared library
   exports it under its own name. A static library may hold several FMUs: there the compiler is
   given FMI2_FUNCTION_PREFIX or FMI3_FUNCTION_PREFIX, and FULL_NAME(name) begins with that. */

#ifndef EJECTOR_EXPORT_H
#define EJECTOR_EXPORT_H

#if defined(FMI2_FUNCTION_PREFIX)
#define FMI_PREFIX FMI2_FUNCTION_PREFIX
#elif defined(FMI3_FUNCTION_PREFIX)
#define FMI_PREFIX FMI3_FUNCTION_PREFIX
#endif

#if defined(FMI_PREFIX)
#define JOIN(prefix, name) prefix##name
#define JOINED(prefix, name) JOIN(prefix, name)
#define FULL_NAME(name) JOINED(FMI_PREFIX, name)
#define API(type, name) type FULL_NAME(name)
#else
#define FULL_NAME(name) name
#if defined(_WIN32)
#define API(type, name) __declspec(dllexport) type name
#elif defined(__GNUC__)
#define API(type, name) __attribute__((visibility("default"))) type name
#else
#define API(type, name) type name
#endif
#endif

#endif
