/* The STM32F401's registers that the firmware uses, after reference manual RM0368 and, for the
 * core's, PM0214. Names of registers and bits are theirs. */
#ifndef STM32F401_H
#define STM32F401_H

#include <stdint.h>

typedef volatile uint32_t reg;

struct rcc {
    reg CR, PLLCFGR, CFGR, CIR;                /* 0x00 */
    reg AHB1RSTR, AHB2RSTR, reserved_18[2];    /* 0x10 */
    reg APB1RSTR, APB2RSTR, reserved_28[2];    /* 0x20 */
    reg AHB1ENR, AHB2ENR, reserved_38[2];      /* 0x30 */
    reg APB1ENR, APB2ENR;                      /* 0x40 */
};
#define RCC ((struct rcc *)0x40023800u)
#define RCC_CR_PLLON (1u << 24)
#define RCC_CR_PLLRDY (1u << 25)
#define RCC_PLLCFGR_PLLM 0u /* position */
#define RCC_PLLCFGR_PLLN 6u /* position */
#define RCC_PLLCFGR_PLLP 16u /* position */
#define RCC_PLLCFGR_PLLQ 24u /* position */
#define RCC_CFGR_SW_PLL (2u << 0)
#define RCC_CFGR_SWS (3u << 2)
#define RCC_CFGR_SWS_PLL (2u << 2)
#define RCC_CFGR_PPRE1_DIV2 (4u << 10)
#define RCC_AHB1ENR_GPIOAEN (1u << 0)
#define RCC_AHB1ENR_GPIOBEN (1u << 1)
#define RCC_AHB1ENR_GPIOCEN (1u << 2)
#define RCC_AHB1ENR_CRCEN (1u << 12)
#define RCC_AHB1ENR_DMA1EN (1u << 21)
#define RCC_AHB1ENR_DMA2EN (1u << 22)
#define RCC_APB1ENR_TIM2EN (1u << 0)
#define RCC_APB1ENR_TIM3EN (1u << 1)
#define RCC_APB1ENR_TIM4EN (1u << 2)
#define RCC_APB1ENR_TIM5EN (1u << 3)
#define RCC_APB1ENR_SPI2EN (1u << 14)
#define RCC_APB1ENR_SPI3EN (1u << 15)
#define RCC_APB1RSTR_SPI2RST (1u << 14)
#define RCC_APB2ENR_ADC1EN (1u << 8)
#define RCC_APB2ENR_SYSCFGEN (1u << 14)

struct flash {
    reg ACR; /* 0x00 */
};
#define FLASH ((struct flash *)0x40023C00u)
#define FLASH_ACR_LATENCY 0u /* position */
#define FLASH_ACR_PRFTEN (1u << 8)
#define FLASH_ACR_ICEN (1u << 9)
#define FLASH_ACR_DCEN (1u << 10)

struct gpio {
    reg MODER, OTYPER, OSPEEDR, PUPDR; /* 0x00 */
    reg IDR, ODR, BSRR, LCKR;          /* 0x10 */
    reg AFRL, AFRH;                    /* 0x20 */
};
#define GPIOA ((struct gpio *)0x40020000u)
#define GPIOB ((struct gpio *)0x40020400u)
#define GPIOC ((struct gpio *)0x40020800u)

struct syscfg {
    reg MEMRM, PMC;                             /* 0x00 */
    reg EXTICR1, EXTICR2, EXTICR3, EXTICR4;     /* 0x08 */
};
#define SYSCFG ((struct syscfg *)0x40013800u)
#define SYSCFG_EXTICR1_EXTI1 4u /* position */
#define SYSCFG_EXTICR4_EXTI13 4u /* position */

struct exti {
    reg IMR, EMR, RTSR, FTSR, SWIER, PR; /* 0x00 */
};
#define EXTI ((struct exti *)0x40013C00u)

struct dma_stream {
    reg CR, NDTR, PAR, M0AR, M1AR, FCR;
};
struct dma {
    reg LISR, HISR, LIFCR, HIFCR; /* 0x00 */
    struct dma_stream stream[8];  /* 0x10, each 0x18 */
};
#define DMA1 ((struct dma *)0x40026000u)
#define DMA2 ((struct dma *)0x40026400u)
#define DMA_CR_EN (1u << 0)
#define DMA_CR_HTIE (1u << 3)
#define DMA_CR_TCIE (1u << 4)
#define DMA_CR_DIR_TO_PERIPHERAL (1u << 6)
#define DMA_CR_DIR_IN_MEMORY (2u << 6)
#define DMA_CR_CIRC (1u << 8)
#define DMA_CR_PINC (1u << 9)
#define DMA_CR_MINC (1u << 10)
#define DMA_CR_PSIZE_16 (1u << 11)
#define DMA_CR_PSIZE_32 (2u << 11)
#define DMA_CR_MSIZE_16 (1u << 13)
#define DMA_CR_MSIZE_32 (2u << 13)
#define DMA_CR_PL_HIGH (2u << 16)
#define DMA_CR_PL_HIGHEST (3u << 16)
#define DMA_CR_DBM (1u << 18)
#define DMA_CR_CT (1u << 19)
#define DMA_CR_CHSEL 25u /* position */
#define DMA_FCR_FTH_FULL (3u << 0)
#define DMA_FCR_DMDIS (1u << 2)
/* the flags of streams 0 and 4; those of 1 and 5 lie 6 bits higher, of 2 and 6 16, of 3 and 7 22 */
#define DMA_ISR_ALL 0x3Du
#define DMA_ISR_HTIF (1u << 4)
#define DMA_ISR_TCIF (1u << 5)

struct spi {
    reg CR1, CR2, SR, DR; /* 0x00 */
};
#define SPI2 ((struct spi *)0x40003800u)
#define SPI3 ((struct spi *)0x40003C00u)
#define SPI_CR1_MSTR (1u << 2)
#define SPI_CR1_BR_DIV4 (1u << 3)
#define SPI_CR1_SPE (1u << 6)
#define SPI_CR1_SSI (1u << 8)
#define SPI_CR1_SSM (1u << 9)
#define SPI_CR2_RXDMAEN (1u << 0)
#define SPI_CR2_TXDMAEN (1u << 1)
#define SPI_SR_TXE (1u << 1)
#define SPI_SR_BSY (1u << 7)

struct tim {
    reg CR1, CR2, SMCR, DIER;     /* 0x00 */
    reg SR, EGR, CCMR1, CCMR2;    /* 0x10 */
    reg CCER, CNT, PSC, ARR;      /* 0x20 */
    reg reserved_30;              /* 0x30 */
    reg CCR1, CCR2, CCR3, CCR4;   /* 0x34 */
};
#define TIM2 ((struct tim *)0x40000000u)
#define TIM3 ((struct tim *)0x40000400u)
#define TIM4 ((struct tim *)0x40000800u)
#define TIM5 ((struct tim *)0x40000C00u)
#define TIM_CR1_CEN (1u << 0)
#define TIM_CR1_URS (1u << 2)
#define TIM_CR2_MMS_RESET (0u << 4)
#define TIM_CR2_MMS_UPDATE (2u << 4)
#define TIM_CR2_MMS_OC1REF (4u << 4)
#define TIM_SMCR_SMS_RESET (4u << 0)
#define TIM_SMCR_SMS_TRIGGER (6u << 0)
#define TIM_SMCR_TS_ITR1 (1u << 4)
#define TIM_SMCR_TS_ITR2 (2u << 4)
#define TIM_DIER_UIE (1u << 0)
#define TIM_DIER_CC2IE (1u << 2)
#define TIM_DIER_CC3IE (1u << 3)
#define TIM_SR_UIF (1u << 0)
#define TIM_SR_CC2IF (1u << 2)
#define TIM_SR_CC3IF (1u << 3)
#define TIM_EGR_UG (1u << 0)
#define TIM_CCMR1_OC1M_PWM1 (6u << 4)
#define TIM_CCMR1_OC1M_PWM2 (7u << 4)
#define TIM_CCMR1_OC2M_PWM2 (7u << 12)
#define TIM_CCMR2_OC3M_PWM2 (7u << 4)
#define TIM_CCMR2_OC4M_PWM2 (7u << 12)
#define TIM_CCER_CC1E (1u << 0)
#define TIM_CCER_CC2E (1u << 4)
#define TIM_CCER_CC3E (1u << 8)
#define TIM_CCER_CC4E (1u << 12)

struct adc {
    reg SR, CR1, CR2, SMPR1, SMPR2; /* 0x00 */
    reg JOFR1, JOFR2, JOFR3, JOFR4; /* 0x14 */
    reg HTR, LTR;                   /* 0x24 */
    reg SQR1, SQR2, SQR3;           /* 0x2C */
    reg JSQR, JDR1, JDR2, JDR3;     /* 0x38 */
    reg JDR4, DR;                   /* 0x48 */
};
#define ADC1 ((struct adc *)0x40012000u)
#define ADC_SR_OVR (1u << 5)
#define ADC_CR2_ADON (1u << 0)
#define ADC_CR2_DMA (1u << 8)
#define ADC_CR2_DDS (1u << 9)
#define ADC_CR2_EXTSEL_TIM4_CC4 (9u << 24)
#define ADC_CR2_EXTEN_RISING (1u << 28)

struct adc_common {
    reg reserved_00, CCR; /* 0x00 */
};
#define ADC_COMMON ((struct adc_common *)0x40012300u)
#define ADC_CCR_ADCPRE_DIV4 (1u << 16)

struct crc {
    reg DR, IDR, CR; /* 0x00 */
};
#define CRC ((struct crc *)0x40023000u)
#define CRC_CR_RESET (1u << 0)

/* --- core -------------------------------------------------------------------------------------- */
struct systick {
    reg CTRL, LOAD, VAL, CALIB;
};
#define SYSTICK ((struct systick *)0xE000E010u)
#define SYSTICK_CTRL_ENABLE (1u << 0)
#define SYSTICK_CTRL_TICKINT (1u << 1)
#define SYSTICK_CTRL_CLKSOURCE (1u << 2)

#define NVIC_ISER ((reg *)0xE000E100u)
#define NVIC_IPR ((volatile uint8_t *)0xE000E400u)
#define SCB_SHPR3 (*(reg *)0xE000ED20u)
#define SCB_SHPR3_SYSTICK 24u /* position */
#define PRIORITY_SHIFT 4u     /* of 8 bits, the upper four are implemented */

enum irq {
    IRQ_EXTI1 = 7,
    IRQ_DMA1_STREAM3 = 14,
    IRQ_TIM2 = 28,
    IRQ_EXTI15_10 = 40,
    IRQ_TIM5 = 50,
    IRQ_DMA2_STREAM0 = 56,
    IRQ_DMA2_STREAM1 = 57,
    IRQ_COUNT = 85
};

#endif
