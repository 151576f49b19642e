/*
@COMMENT@
   model: @SOURCE@
   written by forcegp @VERSION@, do not edit

   Arrays are in the order of the joints, matrices row by row. All functions are re-entrant and return
   @NAME@_OK or bits of what was wrong; results are NaN where they are not known. No result may be an argument, too.
*/
#ifndef @NAME@_H
#define @NAME@_H
#ifdef __cplusplus
extern "C" {
#endif

enum {
  @NAME@_NV = @NV@,
  @NAME@_NQ = @NQ@,
  @NAME@_NU = @NU@,
  @NAME@_OK = 0,
  @NAME@_INPUT_NOT_FINITE = 1,
  @NAME@_RESULT_NOT_FINITE = 4, /* singular there, or outside the range of a table */
  @NAME@_STEP_NOT_FOUND = 8 /* Newton's method did not find an implicit step (take a shorter one), or u */
};

@STATE_OF_MONITOR@@PROTOTYPES@

#ifdef __cplusplus
}
#endif
#endif
