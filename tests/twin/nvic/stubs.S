/* What C cannot say: the vector table, four ways to return from an exception, and trials that
   hold known values in all registers while an exception is taken. */
  .syntax unified
  .cpu cortex-m4
  .fpu fpv4-sp-d16
  .thumb

  .section .vectors, "a"
  .global vectors
vectors:
  .word stack_top
  .word reset
  .word return_by_pop, return_by_bx, return_by_ldr, return_by_ldm   /* 2 to 5 */
  .word return_by_pop, return_by_bx, return_by_ldr, return_by_ldm
  .word return_by_pop, return_by_bx, return_by_ldr, return_by_ldm
  .word return_by_pop, return_by_bx                                 /* PendSV, SysTick */
  .rept 21
  .word return_by_bx, return_by_ldr, return_by_ldm, return_by_pop
  .endr
  .word return_by_bx                                                /* IRQ 84 */

  .text

.macro function name
  .global \name
  .type \name, %function
  .thumb_func
\name:
.endm

function reset
  ldr r0, =0xE000ED88       /* CPACR: full access to CP10, CP11 */
  mov r1, #0xF00000
  str r1, [r0]
  dsb
  isb
  ldr r0, =bss_start
  ldr r1, =bss_end
  movs r2, #0
1:
  cmp r0, r1
  itt lo
  strlo r2, [r0], #4
  blo 1b
  bl run
  b .

/* dispatch(frame, EXC_RETURN) returns the EXC_RETURN to use */
.macro entry
  tst lr, #4
  ite eq
  mrseq r0, msp
  mrsne r0, psp
  mov r1, lr
  push {r2-r10, lr}         /* a multiple of 8 bytes */
  bl dispatch
  str r0, [sp, #36]
  mvn r3, #0                /* nothing the caller may rely on is as it was */
  mov r12, r3
  msr APSR_nzcvqg, r3
.endm

function return_by_pop
  entry
  pop {r2-r10, pc}

function return_by_ldm
  entry
  ldmia sp, {r4-r5}         /* an LDM whose base is not written back, then one that is */
  ldmia.w sp!, {r2-r10, pc}

function return_by_ldr
  entry
  pop {r2-r10}
  ldr pc, [sp], #4

function return_by_bx
  entry
  pop {r2-r10}
  pop {r1}
  bx r1

/* void core_trial(volatile uint32_t *address, uint32_t value, uint32_t after[16]):
   r2 to r12, lr and the flags are known, *address = value, what is in them afterwards. */
function core_trial
  push {r2, r4-r11, lr}
  ldr r2, =0xA80F0000       /* N, C, Q, GE */
  msr APSR_nzcvqg, r2
  ldr r2, =0x22222202
  ldr r3, =0x33333303
  ldr r4, =0x44444404
  ldr r5, =0x55555505
  ldr r6, =0x66666606
  ldr r7, =0x77777707
  ldr r8, =0x88888808
  ldr r9, =0x99999909
  ldr r10, =0xAAAAAA0A
  ldr r11, =0xBBBBBB0B
  ldr r12, =0xCCCCCC0C
  ldr lr, =0xEEEEEE0E
  str r1, [r0]
  dsb
  isb
  push {r0-r12, lr}
  mrs r4, apsr
  ldr r5, [sp, #56]         /* after */
  mov r6, #0
1:
  ldr r7, [sp, r6, lsl #2]
  str r7, [r5, r6, lsl #2]
  add r6, r6, #1
  cmp r6, #14
  bne 1b
  str r4, [r5, #56]
  add sp, sp, #56
  pop {r2, r4-r11, pc}

/* void fpu_trial(volatile uint32_t *address, uint32_t value, uint32_t after[33]):
   the same for s0 to s31 and FPSCR. s(i) is 0x40400000 + i. */
function fpu_trial
  push {r4, lr}
  vpush {s16-s31}
  sub sp, sp, #128
  ldr r3, =0x40400000
  mov r4, #0
1:
  add r12, r3, r4
  str r12, [sp, r4, lsl #2]
  add r4, r4, #1
  cmp r4, #32
  bne 1b
  mov r4, sp
  vldmia r4, {s0-s31}
  ldr r3, =0xA0C00015       /* N, C, round to zero, some exceptions seen */
  vmsr fpscr, r3
  str r1, [r0]
  dsb
  isb
  vstmia r2!, {s0-s31}
  vmrs r3, fpscr
  str r3, [r2]
  mov r3, #0
  vmsr fpscr, r3
  add sp, sp, #128
  vpop {s16-s31}
  pop {r4, pc}

/* void fpu_clobber(void): what a handler that computes may do */
function fpu_clobber
  ldr r0, =0x50500000
  vmov s0, r0
  vmov s1, s0
  vmov s2, s0
  vmov s3, s0
  vmov s4, s0
  vmov s5, s0
  vmov s6, s0
  vmov s7, s0
  vmul.f32 s8, s0, s1
  vmul.f32 s9, s8, s1
  vadd.f32 s10, s0, s1
  vmov s11, s0
  vmov s12, s0
  vmov s13, s0
  vmov s14, s0
  vmov s15, s0
  ldr r0, =0x5040008A
  vmsr fpscr, r0
  bx lr

function fpu_status
  vmrs r0, fpscr
  bx lr

function fpu_set_status
  vmsr fpscr, r0
  bx lr

/* float as bits: x/3 + x, all in the FPU */
function fpu_compute
  vmov s0, r0
  vmov.f32 s1, #3.0
  vdiv.f32 s2, s0, s1
  vadd.f32 s2, s2, s0
  vsqrt.f32 s2, s2
  vmov r0, s2
  bx lr

/* uint32_t it_trial(volatile uint32_t *address, uint32_t value): pends inside IT blocks.
   0x00001D2F: each instruction whose condition holds ran once. */
function it_trial
  movs r2, #0
  movs r3, #0
  cmp r0, r0
  itete eq
  streq r1, [r0]
  addne r2, #1
  addeq r3, #1
  addne r2, #2
  ittt eq
  addeq r3, #2
  streq r1, [r0]
  addeq r3, #4
  ite ne
  addne r2, #4
  streq r1, [r0]
  it eq
  addeq r3, #8
  itttt eq
  addeq r3, #32
  addeq r3, #256
  streq r1, [r0]
  addeq r3, #1024
  iteee ne
  addne r2, #8
  addeq r3, #2048
  streq r1, [r0]
  addeq r3, #4096
  dsb
  isb
  orr r0, r3, r2, lsl #16
  bx lr

/* void multiple_trial(volatile uint32_t *address, uint32_t a, uint32_t b, uint32_t after[9]):
   STM pends, LDM and LDMDB follow without a barrier; values and base registers afterwards */
function multiple_trial
  push {r3-r11, lr}
  mov r12, r3
  ldr r4, =pattern
  stmia r0!, {r1, r2}
  ldmia r4!, {r5-r8}
  ldmdb r4!, {r9-r11}
  ldr r3, =pattern
  sub r4, r4, r3
  dsb
  isb
  stmia r12!, {r0, r4, r5-r11}
  pop {r3-r11, pc}

/* uint32_t exclusive_trial(uint32_t *word, uint32_t unmask):
   LDREX, perhaps let a pending exception in, STREX: 0 stored, 1 refused */
function exclusive_trial
  ldrex r2, [r0]
  cbz r1, 1f
  cpsie i
  isb
1:
  add r2, r2, #1
  strex r3, r2, [r0]
  mov r0, r3
  bx lr

/* void atomic_increment(uint32_t *word): as compilers do it */
function atomic_increment
  ldrex r1, [r0]
  add r1, r1, #1
  strex r2, r1, [r0]
  cmp r2, #0
  bne atomic_increment
  bx lr

/* uint32_t unaligned_trial(volatile uint32_t *address, uint32_t value): SP is 4 modulo 8;
   the change of SP over an exception */
function unaligned_trial
  push {r4-r6, lr}
  mov r4, sp
  sub sp, sp, #4
  mov r5, sp
  str r1, [r0]
  dsb
  isb
  mov r6, sp
  mov sp, r4
  subs r0, r6, r5
  pop {r4-r6, pc}

/* uint32_t integrity(void): one round of work that leaves the same result unless a register,
   a flag or an instruction is lost to an interrupt in it */
function integrity
  push {r4-r11, lr}
  ldr r0, =pattern
  ldmia r0, {r1-r8}
  vldmia r0, {s0-s7}
  add r9, r1, r2
  adds r10, r3, r4
  adcs r10, r10, r5
  it cs
  addcs r9, #1
  ittet mi
  addmi r9, #2
  eormi r9, r9, r6
  addpl r9, #4
  addmi r9, r9, r7, ror #3
  vadd.f32 s8, s0, s1
  vmul.f32 s9, s2, s3
  vcmp.f32 s8, s9
  vmrs APSR_nzcv, fpscr
  ite gt
  vmovgt r11, s8
  vmovle r11, s9
  sub sp, sp, #32
  mov r12, sp
  stmia r12!, {r1-r8}
  sub r12, r12, #32
  ldmia r12!, {r1-r8}
  add sp, sp, #32
  eor r9, r9, r11
  eor r9, r9, r8, ror #5
  umlal r9, r10, r1, r2
  udiv r1, r10, r3
  add r0, r9, r1
  pop {r4-r11, pc}

/* uint32_t on_process_stack(uint32_t (*function)(uint32_t), uint32_t argument, uint32_t *stack):
   on the process stack, thread mode */
function on_process_stack
  push {r4, lr}
  mov r3, r0
  mov r0, r1
  msr psp, r2
  mrs r4, control
  orr r1, r4, #2
  msr control, r1
  isb
  blx r3
  mrs r1, control           /* with FPCA as it is now */
  bic r1, r1, #2
  msr control, r1
  isb
  pop {r4, pc}

function supervisor_call
  svc #0
  bx lr

  .section .rodata
  .align 2
  .ascii "only"             /* by which the test finds what to change */
  .global only
only:
  .word 0xFFFFFFFF
pattern:                    /* floats of various signs and sizes */
  .word 0x3F8CCCCD, 0xC0133333, 0x40533333, 0x408CCCCD, 0xC0B00000, 0x40D33333, 0x40F66666
  .word 0xC10CCCCD
