/* Scenarios for a comparison of exception handling: each runs on bare metal, pends exceptions by
   software and logs what happened in which order. Nothing here knows which processor is right.

   The log is read from RAM: label (offset of a string in flash), exception number (IPSR) where
   it was written, value. A scenario begins with an entry of its name and IPSR 0xFFFF.
   Between a cause and the next note there is always a barrier, after which the architecture
   guarantees that the exception was taken: that much order is defined, no cycle counts. */
#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define SYST_CSR REGISTER(0xE000E010)
#define SYST_RVR REGISTER(0xE000E014)
#define SYST_CVR REGISTER(0xE000E018)
#define NVIC_ISER (&REGISTER(0xE000E100))
#define NVIC_ICER (&REGISTER(0xE000E180))
#define NVIC_ISPR (&REGISTER(0xE000E200))
#define NVIC_ICPR (&REGISTER(0xE000E280))
#define NVIC_IABR (&REGISTER(0xE000E300))
#define NVIC_IPR ((volatile uint8_t *)0xE000E400)
#define ICSR REGISTER(0xE000ED04)
#define VTOR REGISTER(0xE000ED08)
#define AIRCR REGISTER(0xE000ED0C)
#define SCR REGISTER(0xE000ED10)
#define SHPR ((volatile uint8_t *)0xE000ED18 - 4) /* indexed by exception number */
#define SHCSR REGISTER(0xE000ED24)
#define CFSR REGISTER(0xE000ED28)
#define HFSR REGISTER(0xE000ED2C)
#define STIR REGISTER(0xE000EF00)
#define FPCCR REGISTER(0xE000EF34)
#define FPCAR REGISTER(0xE000EF38)
#define FPDSCR REGISTER(0xE000EF3C)

#define NMIPENDSET (1u << 31)
#define PENDSVSET (1u << 28)
#define PENDSVCLR (1u << 27)
#define PENDSTSET (1u << 26)
#define PENDSTCLR (1u << 25)
#define ISRPENDING (1u << 22)
#define RETTOBASE (1u << 11)
#define SLEEPONEXIT (1u << 1)
#define ASPEN (1u << 31)
#define LSPEN (1u << 30)
#define LSPACT (1u << 0)

enum {
  NMI = 2, HARDFAULT = 3, SVCALL = 11, PENDSV = 14, SYSTICK = 15,
  A = 16 + 3, B = 16 + 5, C = 16 + 31, D = 16 + 32, E = 16 + 50, F = 16 + 84,
  LINES = 85, /* of an STM32F401xE; QEMU's STM32F405 has more */
  EXCEPTIONS = 16 + LINES,
};

struct frame {
  uint32_t r0, r1, r2, r3, r12, lr, pc, xpsr;
  uint32_t s[16], fpscr, reserved;
};

typedef void action(struct frame *frame, uint32_t exc_return);

extern uint32_t vectors[EXCEPTIONS];
extern const uint32_t only; /* the index of a scenario that a twin may refuse, or all ones */
extern void core_trial(volatile uint32_t *address, uint32_t value, uint32_t after[15]);
extern void fpu_trial(volatile uint32_t *address, uint32_t value, uint32_t after[33]);
extern void fpu_clobber(void);
extern uint32_t fpu_status(void);
extern void fpu_set_status(uint32_t value);
extern uint32_t fpu_compute(uint32_t bits);
extern uint32_t it_trial(volatile uint32_t *address, uint32_t value);
extern void multiple_trial(volatile uint32_t *address, uint32_t a, uint32_t b, uint32_t after[9]);
extern uint32_t exclusive_trial(uint32_t *word, uint32_t unmask);
extern void atomic_increment(uint32_t *word);
extern uint32_t unaligned_trial(volatile uint32_t *address, uint32_t value);
extern uint32_t integrity(void);
extern uint32_t on_process_stack(uint32_t (*function)(uint32_t), uint32_t argument,
                                 uint32_t *stack);
extern void supervisor_call(void);

void run(void);
uint32_t dispatch(struct frame *frame, uint32_t exc_return);

/* ---- the log, read by the test ---- */
#define CAPACITY 9800u
static struct {
  volatile uint32_t done; /* 1 at the end, 2 when the log is full, 3 on an unexpected fault */
  volatile uint32_t count;
  struct {
    uint16_t label, exception;
    uint32_t value;
  } entries[CAPACITY];
} results __attribute__((section(".bss.results"))); /* at the beginning of RAM */

static uint32_t process_stack[256] __attribute__((aligned(8)));
#define PROCESS_STACK_TOP (process_stack + 256)
static uint32_t table[128] __attribute__((aligned(512)));

static const uint32_t all_lines[3] = {0xFFFFFFFF, 0xFFFFFFFF, (1u << (LINES - 64)) - 1};

static action *actions[EXCEPTIONS];
static uint32_t entered[EXCEPTIONS];
static uint8_t active[EXCEPTIONS];
static uint32_t leave_by; /* EXC_RETURN for the handler about to return, if not 0 */
static volatile uint32_t quiet;

#define READ(special) \
  __extension__({ uint32_t v_; __asm__ volatile("mrs %0, " special : "=r"(v_)::"memory"); v_; })
#define CONTROL() (READ("control") & 7) /* the rest is reserved (DDI 0403E B1.4.4) */
#define WRITE(special, value) \
  __asm__ volatile("msr " special ", %0\n dsb\n isb" ::"r"((uint32_t)(value)) : "memory")
#define barrier() __asm__ volatile("dsb\n isb" ::: "memory")
#define wait() __asm__ volatile("dsb\n wfi\n isb" ::: "memory")
#define mask() __asm__ volatile("cpsid i\n isb" ::: "memory")
#define unmask() __asm__ volatile("cpsie i\n isb" ::: "memory")
#define mask_faults() __asm__ volatile("cpsid f\n isb" ::: "memory")
#define unmask_faults() __asm__ volatile("cpsie f\n isb" ::: "memory")

static void stop(uint32_t why) {
  mask();
  results.done = why;
  for (;;) barrier();
}

static void note_as(uint32_t exception, const char *label, uint32_t value) {
  uint32_t at = results.count;
  if (at >= CAPACITY) stop(2);
  results.entries[at].label = (uint16_t)(uintptr_t)label;
  results.entries[at].exception = (uint16_t)exception;
  results.entries[at].value = value;
  results.count = at + 1;
}

static void note(const char *label, uint32_t value) {
  note_as(READ("ipsr"), label, value);
}

/* every exception comes here */
uint32_t dispatch(struct frame *frame, uint32_t exc_return) {
  uint32_t exception = READ("ipsr");
  if (exception > 2 && exception < SVCALL && !actions[exception]) {
    note("fault at", frame->pc);
    note("cfsr", CFSR);
    note("hfsr", HFSR);
    stop(3);
  }
  entered[exception]++;
  active[exception] = 1;
  if (!quiet) note("enter", exc_return & 0xFF);
  if (actions[exception]) actions[exception](frame, exc_return);
  if (!quiet) note("exit", entered[exception]);
  active[exception] = 0;
  if (leave_by) {
    exc_return = leave_by;
    leave_by = 0;
  }
  return exc_return;
}

/* ---- what scenarios are written in ---- */
static void pend(uint32_t exception) {
  if (exception == NMI) ICSR = NMIPENDSET;
  else if (exception == SVCALL) supervisor_call();
  else if (exception == PENDSV) ICSR = PENDSVSET;
  else if (exception == SYSTICK) ICSR = PENDSTSET;
  else NVIC_ISPR[(exception - 16) / 32] = 1u << (exception - 16) % 32;
  barrier();
}

static void unpend(uint32_t exception) {
  if (exception == PENDSV) ICSR = PENDSVCLR;
  else if (exception == SYSTICK) ICSR = PENDSTCLR;
  else NVIC_ICPR[(exception - 16) / 32] = 1u << (exception - 16) % 32;
  barrier();
}

static void enable(uint32_t exception) {
  NVIC_ISER[(exception - 16) / 32] = 1u << (exception - 16) % 32;
  barrier();
}

static void disable(uint32_t exception) {
  NVIC_ICER[(exception - 16) / 32] = 1u << (exception - 16) % 32;
  barrier();
}

/* 0 to 15: the STM32F4 has the upper four bits */
static void priority(uint32_t exception, uint32_t level) {
  if (exception < 16) SHPR[exception] = (uint8_t)(level << 4);
  else NVIC_IPR[exception - 16] = (uint8_t)(level << 4);
  barrier();
}

static void set(uint32_t exception, uint32_t level, action *act) {
  actions[exception] = act;
  priority(exception, level);
  if (exception >= 16) enable(exception);
}

static void group(uint32_t prigroup) {
  AIRCR = 0x05FA0000u | prigroup << 8;
  barrier();
}

static void basepri(uint32_t level) { WRITE("basepri", level << 4); }
static void basepri_max(uint32_t level) { WRITE("basepri_max", level << 4); }

/* bits of `bit` as 0 or 1 */
static void note_bit(const char *label, uint32_t value, uint32_t bit) {
  note(label, (value & bit) != 0);
}

static void initial_state(void) {
  unmask();
  unmask_faults();
  basepri(0);
  SYST_CSR = 0;
  ICSR = PENDSVCLR | PENDSTCLR;
  for (uint32_t i = 0; i < 3; i++) {
    NVIC_ICER[i] = all_lines[i];
    NVIC_ICPR[i] = all_lines[i];
  }
  for (uint32_t i = 0; i < LINES; i++) NVIC_IPR[i] = 0;
  for (uint32_t i = SVCALL; i < 16; i++)
    if (i == SVCALL || i >= PENDSV) SHPR[i] = 0;
  for (uint32_t i = 0; i < EXCEPTIONS; i++) {
    actions[i] = 0;
    entered[i] = 0;
  }
  group(0);
  FPCCR = ASPEN | LSPEN;
  fpu_set_status(0);
  WRITE("control", 0); /* FPCA too: no floating-point context */
  quiet = 0;
}

#define SCENARIO(name) static void scenario_##name(void)
#define ACTION(name) \
  static void name(struct frame *frame __attribute__((unused)), \
                   uint32_t exc_return __attribute__((unused)))

ACTION(pend_a) { pend(A); }
ACTION(pend_b) { pend(B); }
ACTION(pend_c) { pend(C); }
ACTION(pend_d) { pend(D); }
ACTION(pend_systick) { pend(SYSTICK); }

/* ---- order of exceptions ---- */
ACTION(pend_c_then_look) {
  pend(C);
  note("iabr0", NVIC_IABR[0]);
}

SCENARIO(nesting) {
  set(A, 12, pend_b);
  set(B, 8, pend_c_then_look);
  set(C, 4, pend_d);
  set(D, 1, 0);
  pend(A);
}

SCENARIO(nesting_of_system_exceptions) {
  set(PENDSV, 15, pend_systick);
  set(SYSTICK, 11, pend_a);
  set(A, 7, pend_b);
  set(B, 0, 0);
  pend(PENDSV);
}

ACTION(pend_all) {
  pend(F);
  pend(E);
  pend(D);
  pend(C);
  pend(A);
}

SCENARIO(equal_priorities) {
  for (uint32_t i = 0; i < 3; i++) NVIC_ISER[i] = all_lines[i];
  for (uint32_t i = 0; i < LINES; i++) NVIC_IPR[i] = 0x50;
  actions[B] = pend_all;
  pend(B);
}

SCENARIO(equal_priorities_in_one_write) {
  set(16 + 9, 6, 0);
  set(16 + 7, 6, 0);
  set(16 + 30, 6, 0);
  set(16 + 8, 2, 0);
  NVIC_ISPR[0] = 1u << 7 | 1u << 8 | 1u << 9 | 1u << 30;
  barrier();
}

SCENARIO(equal_priorities_system_before_irq) {
  set(SYSTICK, 9, 0);
  set(PENDSV, 9, 0);
  set(16, 9, 0);
  mask();
  pend(16);
  pend(SYSTICK);
  pend(PENDSV);
  unmask();
}

SCENARIO(late_arrival) {
  uint32_t after[9];
  set(C, 9, 0);
  set(D, 3, 0);
  /* one instruction pends the lower priority first */
  multiple_trial(NVIC_ISPR, 1u << 31, 1u << 0, after);
}

ACTION(pend_three_lower) {
  pend(D);
  pend(B);
  pend(C);
}

SCENARIO(tail_chaining) {
  set(A, 2, pend_three_lower);
  set(B, 9, 0);
  set(C, 5, 0);
  set(D, 12, 0);
  pend(A);
  note("thread", 0);
}

SCENARIO(tail_chaining_inside_a_handler) {
  set(A, 12, pend_b);
  set(B, 4, pend_c); /* C is between A and B: taken before A goes on */
  set(C, 8, 0);
  pend(A);
}

ACTION(pend_itself) {
  if (entered[A] < 4) pend(A);
}

SCENARIO(pend_itself_in_handler) {
  set(A, 5, pend_itself);
  pend(A);
  note("thread", entered[A]);
}

ACTION(pend_twice) {
  pend(B);
  pend(B);
}

SCENARIO(pended_twice_is_taken_once) {
  set(A, 5, pend_twice);
  set(B, 6, 0);
  pend(A);
}

ACTION(pend_b_c_d) {
  pend(D);
  pend(C);
  pend(B);
}

SCENARIO(subpriorities) {
  for (uint32_t prigroup = 3; prigroup < 8; prigroup++) {
    initial_state();
    note("prigroup", prigroup);
    group(prigroup);
    set(A, 13, pend_b_c_d);
    set(B, 12, 0);
    set(C, 9, 0);
    set(D, 6, 0);
    pend(A);
  }
}

SCENARIO(subpriority_orders_pending) {
  group(7); /* no preemption at all */
  set(A, 3, pend_b_c_d);
  set(B, 3, 0);
  set(C, 2, 0);
  set(D, 1, 0);
  pend(A);
}

ACTION(pend_b_then_regroup) {
  pend(B); /* same group: waits */
  note("same group", 0);
  group(3);
  note("other group", 0);
}

SCENARIO(prigroup_changed_while_active) {
  group(5);
  set(A, 7, pend_b_then_regroup);
  set(B, 4, 0);
  pend(A);
}

ACTION(lower_itself) {
  pend(B);
  note("lower", 0);
  priority(A, 12);
  note("raise", 0);
  priority(A, 4);
  pend(B);
  note("end", 0);
}

SCENARIO(priority_changed_while_active) {
  set(A, 4, lower_itself);
  set(B, 8, 0);
  pend(A);
}

ACTION(lower_the_preempted) {
  priority(A, 2); /* the preempted handler becomes more urgent than this one */
  pend(C);        /* less urgent than A, more than B: waits for both */
  note("waits", ICSR & 0x1FF);
}

SCENARIO(preempted_priority_counts) {
  set(A, 9, pend_b);
  set(B, 6, lower_the_preempted);
  set(C, 4, 0);
  pend(A);
}

SCENARIO(priority_changed_while_pending) {
  set(A, 4, 0);
  set(B, 8, 0);
  set(C, 6, 0);
  mask();
  pend(A);
  pend(B);
  pend(C);
  priority(B, 1);
  priority(A, 15);
  unmask();
}

SCENARIO(disabled_stays_pending) {
  set(A, 4, 0);
  disable(A);
  pend(A);
  note("disabled", NVIC_ISPR[0]);
  enable(A);
  note("enabled", NVIC_ISPR[0]);
}

ACTION(disable_itself) {
  disable(A);
  pend(A);
}

SCENARIO(disabled_in_its_handler) {
  set(A, 4, disable_itself);
  pend(A);
  note("iser0", NVIC_ISER[0]);
  note("icer0", NVIC_ICER[0]);
  actions[A] = 0;
  enable(A);
}

SCENARIO(disabled_while_pending) {
  set(A, 4, 0);
  set(B, 5, 0);
  mask();
  pend(A);
  pend(B);
  disable(A);
  unmask();
  note("ispr0", NVIC_ISPR[0]);
  enable(A);
}

SCENARIO(pending_cleared) {
  set(A, 4, 0);
  set(B, 5, 0);
  set(PENDSV, 6, 0);
  set(SYSTICK, 7, 0);
  mask();
  pend(A);
  pend(B);
  pend(PENDSV);
  pend(SYSTICK);
  unpend(A);
  unpend(PENDSV);
  note("icpr0", NVIC_ICPR[0]);
  unmask();
  mask();
  pend(PENDSV);
  pend(SYSTICK);
  unpend(SYSTICK);
  unmask();
}

ACTION(clear_itself) {
  note("pending", NVIC_ISPR[0]);
  pend(A);
  note("pended", NVIC_ISPR[0]);
  unpend(A); /* pending, not active */
  note("active", NVIC_IABR[0]);
}

SCENARIO(cleared_in_its_handler) {
  set(A, 4, clear_itself);
  pend(A);
}

SCENARIO(software_trigger_register) {
  set(E, 4, 0);
  set(F, 2, 0);
  set(16, 3, 0);
  mask();
  STIR = 50;
  STIR = 84;
  STIR = 0;
  barrier();
  unmask();
}

ACTION(pend_a_b) {
  pend(B);
  pend(A);
  note("svc", 0);
}

SCENARIO(svc_between_irqs) {
  set(SVCALL, 8, pend_a_b);
  set(A, 4, 0);
  set(B, 12, 0);
  pend(SVCALL);
  note("thread", 0);
}

ACTION(call_supervisor) { pend(SVCALL); }

SCENARIO(svc_from_a_handler) {
  set(A, 9, call_supervisor);
  set(SVCALL, 3, pend_b);
  set(B, 6, 0);
  pend(A);
}

SCENARIO(svc_with_pendsv_pending) {
  set(SVCALL, 4, 0);
  set(PENDSV, 8, 0);
  basepri(6);
  pend(PENDSV);
  pend(SVCALL);
  note("pendsv masked", (ICSR & PENDSVSET) != 0);
  basepri(0);
}

ACTION(pend_pendsv_systick) {
  pend(PENDSV);
  pend(SYSTICK);
}

SCENARIO(pendsv_after_svc) {
  set(SVCALL, 15, pend_pendsv_systick);
  set(PENDSV, 15, 0);
  set(SYSTICK, 15, 0);
  pend(SVCALL);
}

SCENARIO(pendsv_and_systick) {
  static const uint8_t priorities[3][2] = {{15, 14}, {15, 15}, {14, 15}};
  for (uint32_t i = 0; i < 3; i++) {
    set(PENDSV, priorities[i][0], 0);
    set(SYSTICK, priorities[i][1], 0);
    mask();
    ICSR = PENDSVSET | PENDSTSET;
    barrier();
    unmask();
    note("next", i);
  }
}

ACTION(look_at_shcsr) { note("shcsr", SHCSR & 0x8D80); }
ACTION(look_then_systick) {
  note("shcsr", SHCSR & 0x8D80);
  pend(SYSTICK);
}
ACTION(look_then_svc) {
  note("shcsr", SHCSR & 0x8D80);
  pend(SVCALL);
}

SCENARIO(active_system_exceptions) {
  set(PENDSV, 9, look_then_systick);
  set(SYSTICK, 8, look_then_svc);
  set(SVCALL, 7, look_at_shcsr);
  pend(PENDSV);
  look_at_shcsr(0, 0);
}

/* ---- masks ---- */
SCENARIO(basepri_masks_equal_and_lower) {
  set(A, 9, 0);
  set(B, 8, 0);
  set(C, 7, 0);
  basepri(8);
  pend(A);
  pend(B);
  pend(C);
  note("basepri", READ("basepri"));
  basepri(9);
  note("basepri", READ("basepri"));
  basepri(0);
  note("basepri", READ("basepri"));
}

SCENARIO(basepri_max_only_raises) {
  static const uint8_t levels[] = {0, 9, 12, 0, 5, 6, 1, 15};
  set(A, 5, 0);
  for (uint32_t i = 0; i < sizeof levels; i++) {
    basepri_max(levels[i]);
    note("basepri", READ("basepri"));
    note("basepri_max", READ("basepri_max"));
    pend(A);
  }
  basepri(0);
}

SCENARIO(basepri_and_groups) {
  group(6); /* of the priority, one bit groups */
  set(A, 7, 0);
  set(B, 8, 0);
  basepri(15); /* group 8 to 15 masked */
  pend(B);
  pend(A);
  basepri(7); /* group 0 to 7: all masked */
  pend(A);
  note("masked", NVIC_ISPR[0]);
  basepri(0);
}

ACTION(raise_basepri) {
  basepri(3);
  pend(B);
  pend(C);
  note("masked", 0);
  basepri(0);
}

SCENARIO(basepri_in_a_handler) {
  set(A, 9, raise_basepri);
  set(B, 5, 0);
  set(C, 2, 0);
  pend(A);
}

ACTION(leave_basepri) {
  basepri(6);
  pend(B);
}

SCENARIO(basepri_survives_return) {
  set(A, 9, leave_basepri);
  set(B, 8, 0);
  pend(A);
  note("basepri", READ("basepri"));
  basepri(0);
}

SCENARIO(basepri_below_the_active_priority) {
  set(A, 4, leave_basepri); /* BASEPRI 6 neither lowers nor raises priority 4 */
  set(B, 5, 0);
  pend(A);
  basepri(0);
}

SCENARIO(primask) {
  set(A, 0, 0);
  set(B, 5, 0);
  mask();
  pend(B);
  pend(A);
  note("primask", READ("primask"));
  unmask();
  note("primask", READ("primask"));
}

ACTION(mask_and_pend) {
  mask();
  pend(B);
  note("masked", 0);
}

SCENARIO(primask_survives_return) {
  set(A, 9, mask_and_pend);
  set(B, 5, 0);
  pend(A);
  note("primask", READ("primask"));
  unmask();
}

SCENARIO(faultmask) {
  set(A, 0, 0);
  mask_faults();
  pend(A);
  note("faultmask", READ("faultmask"));
  unmask_faults();
  note("faultmask", READ("faultmask"));
}

ACTION(mask_faults_and_pend) {
  mask_faults();
  pend(B);
  pend(C);
  note("faultmask", READ("faultmask"));
}

SCENARIO(faultmask_ends_with_the_handler) {
  set(A, 9, mask_faults_and_pend);
  set(B, 5, 0);
  set(C, 12, 0);
  pend(A);
  note("faultmask", READ("faultmask"));
}

/* ---- WFI ---- */
SCENARIO(wfi_under_primask) {
  set(A, 5, 0);
  mask();
  pend(A);
  wait(); /* does not sleep, and nothing is taken */
  note("awake", NVIC_ISPR[0]);
  unmask();
}

SCENARIO(wfi_until_systick) {
  set(SYSTICK, 5, 0);
  SYST_RVR = 9999;
  SYST_CVR = 0;
  SYST_CSR = 7;
  wait();
  note("awake", entered[SYSTICK]);
  wait();
  note("awake", entered[SYSTICK]);
  mask();
  wait();
  note("masked", entered[SYSTICK]);
  unmask();
  SYST_CSR = 0;
}

ACTION(stop_systick) { SYST_CSR = 0; }
ACTION(wait_for_systick) {
  note("sleep", 0);
  wait();
  note("awake", entered[SYSTICK]);
}

SCENARIO(wfi_in_a_handler) {
  set(SYSTICK, 5, stop_systick);
  set(A, 9, wait_for_systick);
  SYST_RVR = 9999;
  SYST_CVR = 0;
  SYST_CSR = 7;
  pend(A);
}

SCENARIO(wfi_not_woken_by_basepri) {
  set(SYSTICK, 5, stop_systick);
  set(A, 9, 0);
  basepri(7);
  pend(A);
  SYST_RVR = 9999;
  SYST_CVR = 0;
  SYST_CSR = 7;
  wait();
  note("awake", entered[SYSTICK]);
  while (!entered[SYSTICK]) wait();
  basepri(0);
}

ACTION(stay_awake) {
  if (entered[SYSTICK] == 2) {
    SCR = 0;
    SYST_CSR = 0;
  }
}

SCENARIO(sleep_on_exit) {
  set(SYSTICK, 5, stay_awake);
  set(A, 9, 0);
  SYST_RVR = 9999;
  SYST_CVR = 0;
  SCR = SLEEPONEXIT;
  SYST_CSR = 7;
  pend(A); /* returns to sleep; the second SysTick lets the thread go on */
  note("thread", entered[SYSTICK]);
  while (entered[SYSTICK] < 2) wait();
  SCR = 0;
}

/* ---- registers ---- */
ACTION(look_at_frame) {
  note("xpsr", frame->xpsr & ~0x3FFu);
  note("number in xpsr", frame->xpsr & 0x1FF);
  note("r12", frame->r12);
  note("frame alignment", (uint32_t)frame & 7);
  note("control", CONTROL());
}

SCENARIO(core_registers) {
  uint32_t after[15];
  static const uint8_t irqs[] = {28, 29, 30, 31}; /* each way of returning */
  for (uint32_t i = 0; i < sizeof irqs; i++) {
    set(16u + irqs[i], 5, look_at_frame);
    core_trial(NVIC_ISPR, 1u << irqs[i], after);
    for (uint32_t j = 1; j < 15; j++) note("register", after[j]);
  }
}

SCENARIO(core_registers_through_nesting) {
  uint32_t after[15];
  set(A, 9, pend_b);
  set(B, 5, pend_c);
  set(C, 1, 0);
  core_trial(NVIC_ISPR, 1u << (A - 16), after);
  for (uint32_t j = 1; j < 15; j++) note("register", after[j]);
  mask(); /* after a tail-chained handler too */
  pend(B);
  core_trial(NVIC_ISPR, 1u << (A - 16), after);
  unmask();
}

SCENARIO(if_then_blocks) {
  set(A, 5, 0);
  note("result", it_trial(NVIC_ISPR, 1u << (A - 16)));
  note("taken", entered[A]);
}

SCENARIO(load_and_store_multiple) {
  uint32_t after[9];
  set(C, 9, 0);
  set(D, 9, 0);
  multiple_trial(NVIC_ISPR, 1u << 31, 1u << 0, after);
  note("base", after[0] - (uint32_t)NVIC_ISPR);
  for (uint32_t i = 1; i < 9; i++) note("value", after[i]);
}

static uint32_t word;

/* changes it, since not every engine has a monitor that an exception clears */
ACTION(change_word) { word += 10; }

SCENARIO(exclusive_access) {
  word = 5;
  set(A, 9, change_word);
  note("refused", exclusive_trial(&word, 0));
  note("word", word);
  mask();
  pend(A);
  note("refused", exclusive_trial(&word, 1));
  note("word", word);
  note("refused", exclusive_trial(&word, 1));
  note("word", word);
}

ACTION(look_at_alignment) {
  note("padded", frame->xpsr >> 9 & 1);
  note("frame alignment", (uint32_t)frame & 7);
}

static uint32_t unaligned_on(uint32_t irq) {
  return unaligned_trial(NVIC_ISPR, 1u << irq);
}

SCENARIO(stack_alignment) {
  set(A, 9, look_at_alignment);
  pend(A);
  note("stack moved", unaligned_trial(NVIC_ISPR, 1u << (A - 16)));
  note("stack moved", on_process_stack(unaligned_on, A - 16, PROCESS_STACK_TOP));
}

ACTION(look_at_stack) {
  uint32_t address = (uint32_t)frame;
  note("exc_return", exc_return);
  note("frame on process stack",
       address >= (uint32_t)process_stack && address < (uint32_t)PROCESS_STACK_TOP);
  note("psp is frame", READ("psp") == address);
  note("control", CONTROL());
}

ACTION(look_at_stack_pend_b) {
  look_at_stack(frame, exc_return);
  pend(B);
  pend(C);
}

static uint32_t pend_on(uint32_t exception) {
  note("control", CONTROL());
  pend(exception);
  note("control", CONTROL());
  return 0;
}

SCENARIO(process_stack) {
  set(A, 9, look_at_stack_pend_b);
  set(B, 5, look_at_stack); /* nested: on the main stack */
  set(C, 10, look_at_stack); /* tail-chained: the thread's frame */
  on_process_stack(pend_on, A, PROCESS_STACK_TOP);
}

static uint32_t compute_then_pend(uint32_t exception) {
  note("computed", fpu_compute(0x40490FDB));
  return pend_on(exception);
}

SCENARIO(process_stack_and_fpu) {
  set(A, 9, look_at_stack_pend_b);
  set(B, 5, look_at_stack);
  set(C, 10, look_at_stack);
  on_process_stack(compute_then_pend, A, PROCESS_STACK_TOP);
}

ACTION(switch_stacks) {
  /* as a scheduler does: leave to a frame made by hand */
  struct frame *made = (struct frame *)(PROCESS_STACK_TOP - 32);
  made->r0 = frame->r0;
  made->r1 = frame->r1;
  made->r2 = frame->r2;
  made->r3 = frame->r3;
  made->r12 = frame->r12;
  made->lr = frame->lr;
  made->pc = frame->pc;
  made->xpsr = frame->xpsr;
  __asm__ volatile("msr psp, %0" ::"r"(made) : "memory");
  leave_by = exc_return | 4;
}

ACTION(switch_back) {
  struct frame *made = (struct frame *)READ("psp");
  note("frame is psp", made == frame);
}

SCENARIO(exception_return_to_the_other_stack) {
  set(A, 9, switch_stacks);
  set(B, 5, switch_back);
  uint32_t before = READ("msp");
  uint32_t address = (uint32_t)NVIC_ISPR;
  uint32_t control, psp;
  /* SP changes under the compiler's feet: all of it in one piece of assembly */
  __asm__ volatile(
      "str %[a], [%[reg]]\n dsb\n isb\n"    /* comes back on the process stack */
      "mrs %[control], control\n mrs %[psp], psp\n"
      "str %[b], [%[reg]]\n dsb\n isb\n"
      "mov r3, #0\n msr control, r3\n isb\n"
      : [control] "=&r"(control), [psp] "=&r"(psp)
      : [reg] "r"(address), [a] "r"(1u << (A - 16)), [b] "r"(1u << (B - 16))
      : "r3", "memory");
  note("control", control & 7);
  note("psp", (uint32_t)PROCESS_STACK_TOP - psp);
  /* A's frame was left on the main stack */
  note("msp", before - READ("msp"));
  __asm__ volatile("msr msp, %0" ::"r"(before) : "memory");
}

ACTION(look_at_icsr) {
  uint32_t icsr = ICSR;
  note("vectactive", icsr & 0x1FF);
  note_bit("rettobase", icsr, RETTOBASE);
  note_bit("isrpending", icsr, ISRPENDING);
  note_bit("pendsv", icsr, PENDSVSET);
  note_bit("pendst", icsr, PENDSTSET);
  note("vectpending", icsr >> 12 & 0x1FF);
  note("iabr", NVIC_IABR[0]);
  note("iabr", NVIC_IABR[1]);
  note("iabr", NVIC_IABR[2]);
}

ACTION(look_at_icsr_pend_f) {
  look_at_icsr(frame, exc_return);
  pend(F);
  look_at_icsr(frame, exc_return);
}

ACTION(pend_for_icsr) {
  pend(PENDSV);
  pend(A);
  look_at_icsr(frame, exc_return);
}

SCENARIO(interrupt_control_and_state) {
  set(E, 9, look_at_icsr_pend_f);
  set(F, 5, pend_for_icsr);
  set(A, 14, look_at_icsr);
  set(PENDSV, 15, look_at_icsr);
  pend(E);
  note("vectactive", ICSR & 0x1FF);
}

SCENARIO(vectpending_under_primask) {
  set(A, 9, 0);
  set(PENDSV, 3, 0);
  disable(A);
  mask();
  pend(A);
  note("disabled", ICSR >> 12 & 0x1FF);
  note_bit("isrpending", ICSR, ISRPENDING);
  enable(A);
  note("enabled", ICSR >> 12 & 0x1FF);
  pend(PENDSV);
  note("more urgent", ICSR >> 12 & 0x1FF);
  unmask();
  note("none", ICSR >> 12 & 0x1FF);
}

SCENARIO(vectpending_under_basepri) {
  set(A, 9, 0);
  basepri(5);
  pend(A);
  note("vectpending", ICSR >> 12 & 0x1FF);
  note_bit("isrpending", ICSR, ISRPENDING);
  basepri(0);
}

SCENARIO(registers_of_the_nvic) {
  set(C, 9, 0);
  set(D, 9, 0);
  disable(D);
  mask();
  pend(C);
  pend(D);
  for (uint32_t i = 0; i < 2; i++) {
    note("iser", NVIC_ISER[i]);
    note("icer", NVIC_ICER[i]);
    note("ispr", NVIC_ISPR[i]);
    note("icpr", NVIC_ICPR[i]);
    note("iabr", NVIC_IABR[i]);
  }
  note("ipr", REGISTER(0xE000E400 + 28));
  REGISTER(0xE000E400 + 28) = 0x40302010; /* 31 is the uppermost byte */
  note("ipr", NVIC_IPR[31]);
  priority(PENDSV, 7);
  priority(SYSTICK, 11);
  note("shpr3", REGISTER(0xE000ED20));
  REGISTER(0xE000ED1C) = 0x30000000;
  note("shpr2", SHPR[SVCALL]);
  NVIC_ISER[1] = 0; /* zeros have no effect */
  NVIC_ICER[0] = 0;
  NVIC_ICPR[0] = 0;
  group(5);
  note("aircr", AIRCR);
  unmask();
}

SCENARIO(priority_bits) {
  NVIC_IPR[3] = 0xFF;
  note("ipr", NVIC_IPR[3]);
  SHPR[PENDSV] = 0x9F;
  note("shpr", SHPR[PENDSV]);
}

SCENARIO(basepri_of_other_bits) {
  set(A, 9, 0);
  WRITE("basepri", 0x0F);
  pend(A);
  note("pending", NVIC_ISPR[0]);
  basepri(0);
}

ACTION(other_handler) { note("vectors in RAM", VTOR == (uint32_t)table); }

SCENARIO(vector_table_moved) {
  set(A, 9, other_handler);
  set(B, 9, other_handler);
  for (uint32_t i = 0; i < EXCEPTIONS; i++) table[i] = vectors[i];
  table[A] = vectors[B]; /* IPSR stays A's */
  VTOR = (uint32_t)table;
  barrier();
  pend(A);
  pend(B);
  VTOR = (uint32_t)vectors;
  barrier();
  pend(A);
}

/* ---- floating point ---- */
ACTION(use_fpu) { fpu_clobber(); }

ACTION(look_at_fpu) {
  note("fpca", CONTROL() & 4);
  fpu_clobber();
  note("fpca", CONTROL() & 4);
  if (!(exc_return & 0x10)) {
    uint32_t wrong = 0;
    for (uint32_t i = 0; i < 16; i++) wrong |= (uint32_t)(frame->s[i] != 0x40400000 + i) << i;
    note("wrong in frame", wrong);
    note("fpscr in frame", frame->fpscr);
  }
}

static void note_fpu(void) {
  uint32_t after[33];
  uint32_t changed = 0;
  fpu_trial(NVIC_ISPR, 1u << (A - 16), after);
  for (uint32_t i = 0; i < 32; i++) changed |= (uint32_t)(after[i] != 0x40400000 + i) << i;
  note("changed", changed);
  note("fpscr", after[32]);
  note("control", CONTROL());
}

SCENARIO(fpu_lazy_stacking) {
  set(A, 5, look_at_fpu);
  note_fpu();
}

SCENARIO(fpu_eager_stacking) {
  set(A, 5, look_at_fpu);
  FPCCR = ASPEN;
  note_fpu();
}

SCENARIO(fpu_handler_without_floating_point) {
  set(A, 5, 0);
  note_fpu();
}

ACTION(use_fpu_pend_b) {
  fpu_clobber();
  pend(B);
  note("fpscr", fpu_status());
}

ACTION(pend_b_use_fpu) {
  pend(B); /* with the thread's registers not stacked yet */
  fpu_clobber();
}

SCENARIO(fpu_nested) {
  set(A, 9, use_fpu_pend_b);
  set(B, 5, use_fpu);
  note_fpu();
  actions[A] = pend_b_use_fpu;
  note_fpu();
  actions[A] = pend_b;
  note_fpu();
}

SCENARIO(fpu_tail_chained) {
  set(A, 5, pend_b);
  set(B, 9, use_fpu);
  note_fpu();
  actions[A] = use_fpu_pend_b;
  note_fpu();
}

ACTION(note_status) { note("fpscr", fpu_status()); }

SCENARIO(fpu_context_is_each_handlers_own) {
  set(A, 5, use_fpu);
  set(B, 9, pend_c); /* tail-chained to A, which computed: B and its preemption have no context */
  set(C, 7, 0);
  mask();
  pend(A);
  pend(B);
  unmask();
  note_fpu();
}

SCENARIO(fpu_status_in_a_handler) {
  set(A, 5, note_status);
  note_fpu(); /* not the thread's FPSCR, but FPDSCR */
}

SCENARIO(fpu_context_begins_and_ends) {
  set(A, 5, use_fpu);
  pend(A); /* no context in the thread: a short frame */
  note("control", CONTROL());
  note("computed", fpu_compute(0x40490FDB));
  note("control", CONTROL());
  pend(A);
  note("control", CONTROL());
  WRITE("control", 0);
  pend(A);
  note("control", CONTROL());
}

/* ---- at any instruction ---- */
static volatile uint32_t ticks;
static uint32_t counted; /* by thread and handlers */

ACTION(tick) {
  ticks++;
  atomic_increment(&counted);
  if (ticks % 3 == 0) pend(A);
  if (ticks >= 150) SYST_CSR = 0;
}

static void under_ticks(action *act) {
  uint32_t wrong = 0, rounds = 0, expected;
  set(SYSTICK, 5, tick);
  set(A, 3, act);
  expected = integrity();
  ticks = 0;
  counted = 0;
  quiet = 1;
  SYST_RVR = 999; /* and a prime number of cycles after that */
  SYST_CVR = 0;
  SYST_CSR = 7;
  while (ticks < 150) {
    wrong += integrity() != expected;
    for (uint32_t i = 0; i < 10; i++, rounds++) atomic_increment(&counted);
    SYST_RVR = 700 + ticks % 101;
  }
  quiet = 0;
  note("result", expected);
  note("wrong", wrong);
  note("lost", ticks + rounds - counted);
  note("taken", entered[A]);
}

SCENARIO(asynchronous) { under_ticks(0); }
SCENARIO(asynchronous_with_fpu) { under_ticks(use_fpu); }

/* ---- random sequences ---- */
#ifndef SEED
#define SEED 1
#endif
#define STEPS 400u

static const uint8_t used[] = {0, 1, 5, 6, 15, 16, 28, 31, 32, 50, 63, 84};
#define USED (sizeof used)
static uint32_t state;
static uint32_t steps;
static uint32_t prigroup;

static uint32_t below(uint32_t limit) {
  state ^= state << 13;
  state ^= state >> 17;
  state ^= state << 5;
  return (state >> 8) % limit;
}

/* where SVC is not more urgent than what runs, it is a fault */
static uint32_t svc_possible(void) {
  uint32_t bits = 0xFFu & ~((2u << prigroup) - 1);
  uint32_t running = 0x100;
  if (READ("primask") || READ("faultmask")) return 0;
  if (READ("basepri")) running = READ("basepri") & bits;
  for (uint32_t i = SVCALL; i < EXCEPTIONS; i++) {
    uint32_t level = (i < 16 ? SHPR[i] : NVIC_IPR[i - 16]) & bits;
    if (active[i] && level < running) running = level;
  }
  return (SHPR[SVCALL] & bits) < running;
}

static void step(void) {
  uint32_t irq = used[below(USED)];
  uint32_t level = below(16);
  uint32_t other = used[below(USED)];
  steps++;
  switch (below(36)) {
  default:
    note("pend", irq);
    pend(16 + irq);
    break;
  case 4:
    note("trigger", irq);
    STIR = irq;
    barrier();
    break;
  case 5:
    note("pend two", irq % 32 * 256 + other % 32);
    NVIC_ISPR[0] = (1u << irq % 32 | 1u << other % 32) & 0x90018063;
    barrier();
    break;
  case 6:
    note("unpend", irq);
    unpend(16 + irq);
    break;
  case 7: case 8:
    note("enable", irq);
    enable(16 + irq);
    break;
  case 9:
    note("disable", irq);
    disable(16 + irq);
    break;
  case 10: case 11: case 12:
    note("priority", irq * 256 + level);
    priority(16 + irq, level);
    break;
  case 13: {
    static const uint8_t numbers[] = {SVCALL, PENDSV, SYSTICK};
    uint32_t exception = numbers[other % 3];
    note("priority", exception * 256 + level);
    priority(exception, level);
    break;
  }
  case 14:
    note("basepri", level);
    basepri(level);
    break;
  case 1: case 2: case 15:
    note("no basepri", 0);
    basepri(0);
    break;
  case 16:
    note("basepri_max", level);
    basepri_max(level);
    note("basepri_max", READ("basepri"));
    break;
  case 0: case 17:
    note("primask", level < 4);
    WRITE("primask", level < 4);
    break;
  case 18:
    note("faultmask", level < 4);
    WRITE("faultmask", level < 4);
    break;
  case 19:
    note("pendsv", 0);
    pend(PENDSV);
    break;
  case 20:
    note("systick", 0);
    pend(SYSTICK);
    break;
  case 21:
    note("not pendsv, systick", 0);
    unpend(PENDSV);
    unpend(SYSTICK);
    break;
  case 22:
    note("svc", svc_possible());
    if (svc_possible()) pend(SVCALL);
    break;
  case 23:
    prigroup = other % 8;
    note("prigroup", prigroup);
    group(prigroup);
    break;
  case 24:
    note("computed", fpu_compute(0x40000000 + state % 0x1000000));
    break;
  case 3: {
    uint32_t icsr = ICSR;
    note("icsr", icsr & 0x144001FF);
    note("pending", NVIC_ISPR[0]);
    note("pending", NVIC_ISPR[1]);
    note("active", NVIC_IABR[0]);
    note("active", NVIC_IABR[1]);
    if (READ("ipsr")) note_bit("rettobase", icsr, RETTOBASE);
    break;
  }
  }
}

ACTION(random_steps) {
  for (uint32_t n = below(6); n > 0 && steps < STEPS; n--) step();
}

static void random_sequence(uint32_t seed) {
  uint32_t msp = READ("msp");
  state = seed * 2654435761u + 1;
  for (uint32_t i = 0; i < 8; i++) below(2);
  steps = 0;
  prigroup = 0;
  for (uint32_t i = 0; i < USED; i++) set(16u + used[i], below(16), random_steps);
  set(SVCALL, below(16), random_steps);
  set(PENDSV, below(16), random_steps);
  set(SYSTICK, below(16), random_steps);
  while (steps < STEPS) step();
  note("let all in", 0);
  WRITE("faultmask", 0);
  WRITE("primask", 0);
  basepri(0);
  for (uint32_t i = 0; i < USED; i++) enable(16u + used[i]);
  note("left", NVIC_ISPR[0] | NVIC_ISPR[1] | NVIC_ISPR[2]);
  note("stack moved", READ("msp") - msp);
}

#define RANDOM(n) SCENARIO(random_##n) { random_sequence(SEED * 8u + n); }
RANDOM(0)
RANDOM(1)
RANDOM(2)
RANDOM(3)
RANDOM(4)
RANDOM(5)
RANDOM(6)
RANDOM(7)

/* ---- what a twin may refuse: each runs in an image of its own ---- */
ACTION(pend_nmi_once) {
  note("nmi", 0);
  pend(A);
  if (entered[NMI] == 1) pend(NMI);
}

SCENARIO(nmi) {
  set(A, 0, 0);
  actions[NMI] = pend_nmi_once;
  pend(NMI);
}

ACTION(become_privileged) {
  note("control", CONTROL());
  WRITE("control", CONTROL() & ~1u);
  note("basepri", READ("basepri"));
  note("primask", READ("primask"));
  note("faultmask", READ("faultmask"));
}

SCENARIO(unprivileged_thread) {
  actions[SVCALL] = become_privileged;
  WRITE("control", 1);
  WRITE("primask", 1);
  WRITE("basepri", 0x80);
  WRITE("faultmask", 1);
  WRITE("control", 0);
  note("control", CONTROL());
  pend(SVCALL);
  note("control", CONTROL());
}

SCENARIO(svc_set_pending) {
  set(SVCALL, 5, 0);
  set(A, 3, 0);
  mask();
  SHCSR = 1u << 15;
  pend(A);
  unmask();
}

SCENARIO(fpu_no_stacking) {
  FPCCR = 0;
  set(A, 5, use_fpu);
  note_fpu();
}

SCENARIO(fpu_default_status) {
  set(A, 5, note_status);
  FPDSCR = 0x03C00000;
  note("fpdscr", FPDSCR);
  note("fpscr", fpu_status()); /* a new context begins with FPDSCR */
  note_fpu();
  fpu_set_status(0);
  WRITE("control", 0);
  note("fpscr", fpu_status());
  FPDSCR = 0;
}

SCENARIO(nmi_under_faultmask) {
  set(A, 0, 0);
  mask_faults();
  pend(A);
  pend(NMI); /* whose return does not clear FAULTMASK */
  note("faultmask", READ("faultmask"));
  unmask_faults();
}

ACTION(look_at_lazy_state) {
  note("fpcar is frame", (FPCAR & ~7u) == (uint32_t)frame->s);
  note_bit("lspact", FPCCR, LSPACT);
  fpu_clobber();
  note_bit("lspact", FPCCR, LSPACT);
}

SCENARIO(fpu_lazy_state) {
  set(A, 5, look_at_lazy_state);
  note_fpu();
}

ACTION(note_fault_and_resume) {
  uint16_t instruction = *(uint16_t *)frame->pc;
  note_bit("forced", HFSR, 1u << 30);
  note("cfsr", CFSR);
  /* past the SVC or UDF, should it be the return address */
  if (instruction == 0xDF00 || instruction == 0xDE00) frame->pc += 2;
}

SCENARIO(svc_escalates) {
  actions[HARDFAULT] = note_fault_and_resume;
  set(SVCALL, 9, 0);
  set(A, 9, call_supervisor);
  pend(A);
  mask();
  pend(SVCALL);
  unmask();
  pend(SVCALL);
}

SCENARIO(undefined_instruction) {
  actions[HARDFAULT] = note_fault_and_resume;
  __asm__ volatile("udf #0" ::: "memory");
}

/* ---- all of them ---- */
struct scenario {
  const char *name;
  void (*play)(void);
};
static const struct scenario scenarios[] = {
#define COMMON(name) {#name, scenario_##name},
  COMMON(nesting) COMMON(nesting_of_system_exceptions) COMMON(equal_priorities)
  COMMON(equal_priorities_in_one_write) COMMON(equal_priorities_system_before_irq)
  COMMON(late_arrival) COMMON(tail_chaining) COMMON(tail_chaining_inside_a_handler)
  COMMON(pend_itself_in_handler) COMMON(pended_twice_is_taken_once) COMMON(subpriorities)
  COMMON(subpriority_orders_pending) COMMON(prigroup_changed_while_active)
  COMMON(priority_changed_while_active) COMMON(preempted_priority_counts)
  COMMON(priority_changed_while_pending) COMMON(disabled_stays_pending)
  COMMON(disabled_in_its_handler) COMMON(disabled_while_pending) COMMON(pending_cleared)
  COMMON(cleared_in_its_handler) COMMON(software_trigger_register) COMMON(svc_between_irqs)
  COMMON(svc_from_a_handler) COMMON(svc_with_pendsv_pending) COMMON(pendsv_after_svc)
  COMMON(pendsv_and_systick) COMMON(active_system_exceptions)
  COMMON(basepri_masks_equal_and_lower) COMMON(basepri_max_only_raises) COMMON(basepri_and_groups)
  COMMON(basepri_in_a_handler) COMMON(basepri_survives_return)
  COMMON(basepri_below_the_active_priority) COMMON(primask) COMMON(primask_survives_return)
  COMMON(faultmask) COMMON(faultmask_ends_with_the_handler) COMMON(wfi_under_primask)
  COMMON(wfi_until_systick) COMMON(wfi_in_a_handler) COMMON(wfi_not_woken_by_basepri)
  COMMON(sleep_on_exit) COMMON(core_registers) COMMON(core_registers_through_nesting)
  COMMON(if_then_blocks) COMMON(load_and_store_multiple) COMMON(exclusive_access)
  COMMON(stack_alignment) COMMON(process_stack) COMMON(process_stack_and_fpu)
  COMMON(exception_return_to_the_other_stack) COMMON(interrupt_control_and_state)
  COMMON(vectpending_under_primask) COMMON(vectpending_under_basepri)
  COMMON(registers_of_the_nvic) COMMON(priority_bits) COMMON(basepri_of_other_bits)
  COMMON(vector_table_moved)
  COMMON(fpu_lazy_stacking) COMMON(fpu_eager_stacking) COMMON(fpu_handler_without_floating_point)
  COMMON(fpu_nested) COMMON(fpu_tail_chained)
  COMMON(fpu_context_is_each_handlers_own)
  COMMON(fpu_status_in_a_handler)
  COMMON(fpu_context_begins_and_ends) COMMON(asynchronous) COMMON(asynchronous_with_fpu)
  COMMON(random_0) COMMON(random_1) COMMON(random_2) COMMON(random_3) COMMON(random_4)
  COMMON(random_5) COMMON(random_6) COMMON(random_7)
};
static const struct scenario beyond[] = {
#define BEYOND(name) {#name, scenario_##name},
  BEYOND(nmi) BEYOND(unprivileged_thread) BEYOND(svc_set_pending) BEYOND(fpu_no_stacking)
  BEYOND(fpu_default_status) BEYOND(nmi_under_faultmask) BEYOND(fpu_lazy_state)
  BEYOND(svc_escalates) BEYOND(undefined_instruction)
};

static void play(const struct scenario *scenario) {
  initial_state();
  note_as(0xFFFF, scenario->name, 0);
  scenario->play();
}

void run(void) {
  if (only != 0xFFFFFFFF)
    play(&beyond[only]);
  else
    for (uint32_t i = 0; i < sizeof scenarios / sizeof *scenarios; i++) play(&scenarios[i]);
  initial_state();
  results.done = 1;
}
